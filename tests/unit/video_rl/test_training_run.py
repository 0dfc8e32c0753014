"""A run folder of loop 2: averaged weights, progress, held-out scores and the alarm of DD-2."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from metric_docs import documented, written
from video_toys import tiny_network, toy_buffer, toy_rollout_settings, weights

from wm_nodes.config.load import load_video_config
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.recording import BagError
from wm_nodes.recording.messages import header, message_type, serialize
from wm_nodes.recording.raw import RawBagWriter
from wm_nodes.recording.topics import CLIP_SCORES, CLIPS, DEFAULT_NAMESPACE, RUN_STATE, RecordedTopic, absolute
from wm_nodes.training.metrics import read_metrics
from wm_nodes.training.weights import load_weights
from wm_nodes.video_model import VideoNetwork
from wm_nodes.video_rl.recorded_buffers import read_clips, trained_clips
from wm_nodes.video_rl.reward_hacking import WATCHED, alarm_text, hacked_slopes, hacking_alarms, watched_scores
from wm_nodes.video_rl.training_run import VIDEO_FILES, VideoRun, progress

ROLLOUT = toy_rollout_settings(micro_batch=8)
SCORES = set(WATCHED)


def config(*, every: int = 1, **grpo: Any) -> VideoRlConfig:
    plain = load_video_config("smoke")
    return plain.with_values(
        rollout=ROLLOUT,
        evaluation=plain.evaluation.with_values(every=every, window=3),
        grpo=plain.grpo.with_values(learning_rate=1e-3, **grpo),
    )


def train(run: VideoRun, totals: list[float]) -> None:
    """One buffer for each; its mean reward is the number."""
    for total in totals:
        buffer = toy_buffer(run.network, ROLLOUT, version=run.version, iteration=run.iterations)
        spread = torch.tensor([-1.0, 1.0, -1.0, 1.0]).repeat(2)
        scored = buffer.with_rewards({"total": total + spread})
        raw = {"tracking": spread, "psnr_db": torch.full((8,), math.nan)}
        run.train(replace(scored, rewards={**scored.rewards, **raw}))


def lines(rewards: list[float | None], **scores: list[float]) -> list[dict[str, object]]:
    """An evaluation after every buffer."""
    found: list[dict[str, object]] = []
    for index, reward in enumerate(rewards):
        found.append({"section": "grpo", "step": index + 1, "reward_mean": reward})
        row = {name: values[index] for name, values in scores.items()}
        found.append({"section": "heldout", "step": index + 1, **row})
    return found


def test_an_error_that_grows_while_the_reward_rises_is_named_with_both_slopes() -> None:
    rising = [0.1, 0.2, 0.3]
    alarms = hacking_alarms(lines(rising, object_cm=[5.0, 6.0, 7.0], tracking=[0.1, 0.2, 0.3]), window=3)
    assert alarms == {"hacked": 1, "reward_slope": pytest.approx(0.1), "hacked_object_cm": pytest.approx(-1.0)}
    assert "reward rises by 0.1 per evaluation while held-out scores get worse: object_cm by 1;" in alarm_text(alarms)
    none = {"hacked": 0.0}
    assert hacking_alarms(lines(rising, object_cm=[7.0, 6.0, 5.0], tracking=[0.1, 0.2, 0.3]), window=3) == none
    assert hacking_alarms(lines(rising[::-1], object_cm=[5.0, 6.0, 7.0]), window=3) == none
    assert hacking_alarms(lines(rising[:2], object_cm=[5.0, 6.0]), window=3) == {}, "nothing was looked at"
    assert alarm_text(none) == alarm_text({}) == ""


def test_only_the_newest_evaluations_count() -> None:
    rewards = [0.5, 0.4, 0.3, 0.4, 0.5, 0.6]
    assert hacking_alarms(lines(rewards, tracking=[0.9, 0.5, 0.1, 0.2, 0.3, 0.4]), window=4) == {"hacked": 0.0}
    assert hacking_alarms(lines(rewards, tracking=[0.1, 0.2, 0.9, 0.8, 0.7, 0.6]), window=4)["hacked"] == 1.0


def test_the_reward_of_an_evaluation_is_the_mean_over_the_buffers_since_the_one_before() -> None:
    rows = [{"section": "grpo", "step": i + 1, "reward_mean": float(r)} for i, r in enumerate([1, 3, 2, 4, 5, 3])]
    rows += [{"section": "heldout", "step": step, "psnr_db": 20.0 - step} for step in (2, 4, 6)]
    alarms = hacking_alarms(rows, window=3)  # rewards 2, 3, 4
    assert alarms["reward_slope"] == pytest.approx(1.0) and alarms["hacked_psnr_db"] == pytest.approx(-2.0)


def test_a_missing_value_takes_its_score_out_and_a_missing_reward_its_evaluation() -> None:
    known: list[float | None] = [1.0, 2.0, 3.0]
    rows = lines(known, psnr_db=[3.0, 2.0, 1.0], tracking=[3.0, 2.0, 1.0])
    rows[3]["psnr_db"] = None
    assert list(hacked_slopes(hacking_alarms(rows, window=3))) == ["tracking"]
    assert not hacking_alarms(lines([1.0, None, 3.0], tracking=[3.0, 2.0, 1.0]), window=3)
    rows = lines([1.0, 2.0, 3.0, 4.0], tracking=[math.nan, 3.0, 2.0, 1.0])
    rows[1]["tracking"] = None
    assert list(hacked_slopes(hacking_alarms(rows, window=3))) == ["tracking"], "a null of before mutes for ever"


def test_where_actions_are_given_the_end_of_a_clip_raises_no_alarm() -> None:
    rows = lines([1.0, 2.0, 3.0], success=[0.5, 0.4, 0.3], outcome=[0.5, 0.4, 0.3], tracking=[0.1, 0.2, 0.3])
    assert hacking_alarms(rows, window=3, watched=watched_scores(hide_actions=False)) == {"hacked": 0.0}
    assert hacking_alarms(rows, window=3, watched=watched_scores(hide_actions=True))["hacked"] == 2.0


class Falling:
    """Held-out scores that get worse at every call; also what weights they were asked of."""

    def __init__(self, run_network: torch.nn.Module) -> None:
        self.network, self.seen = run_network, list[dict[str, torch.Tensor]]()

    def __call__(self) -> dict[str, float]:
        self.seen.append(weights(self.network))
        falling = 1.0 - 0.1 * len(self.seen)
        return {"tracking": falling, "success": falling, "psnr_db": 20.0 + len(self.seen), "reward": math.nan}


@pytest.fixture
def network() -> VideoNetwork:
    return tiny_network()


def test_held_out_scores_are_written_every_so_many_buffers_and_the_alarm_with_them(
    tmp_path: Path, network: VideoNetwork
) -> None:
    run = VideoRun(network, config(every=2), tmp_path, heldout=Falling(network))
    train(run, [1, 2, 3, 4])
    assert run.alarms == {}
    run.close()
    heldout = Falling(network)
    heldout.seen = [{}, {}]
    run = VideoRun(network, config(every=2), tmp_path, heldout=heldout)  # resumed: the curve goes on
    train(run, [5, 6])
    run.close()
    written_lines = read_metrics(tmp_path, "heldout")
    assert [(line["step"], line.get("hacked")) for line in written_lines] == [(2, None), (4, None), (6, 1.0)]
    last = written_lines[-1]
    assert last["reward"] is None and last["reward_slope"] == pytest.approx(2.0)
    assert hacked_slopes(run.alarms) == hacked_slopes(last) == {"tracking": pytest.approx(-0.1)}
    assert last["hacked_tracking"] == pytest.approx(-0.1) and "hacked_psnr_db" not in last
    assert written(last, SCORES) | SCORES <= documented("section `heldout`")
    assert written(read_metrics(tmp_path, "grpo")[0], SCORES) == documented("section `grpo`")


def test_an_evaluation_that_the_process_did_not_live_to_see_is_made_up_for(
    tmp_path: Path, network: VideoNetwork
) -> None:
    def killed() -> dict[str, float]:
        raise KeyboardInterrupt

    run = VideoRun(network, config(every=2), tmp_path, heldout=killed)
    with pytest.raises(KeyboardInterrupt):
        train(run, [1, 2])
    run.close()
    wanted, resumed = weights(network), tiny_network(seed=4)
    heldout = Falling(resumed)
    run = VideoRun(resumed, config(every=2), tmp_path, heldout=heldout)
    train(run, [3, 4])
    run.close()
    assert [line["step"] for line in read_metrics(tmp_path, "heldout")] == [2, 4]
    assert all(torch.equal(value, wanted[name]) for name, value in heldout.seen[0].items())


def write_clips(path: Path, iterations: list[int], *others: RecordedTopic) -> Path:
    """The recording of one start of a run: signs of life, and a clip with its score for each iteration."""
    names = {topic: absolute(DEFAULT_NAMESPACE, topic) for topic in (RUN_STATE, *others)}
    with RawBagWriter(path) as bag:
        for topic, name in names.items():
            bag.add_topic(name, topic.msgtype)
        alive = message_type(RUN_STATE.msgtype)
        bag.write(names[RUN_STATE], serialize(alive(header(1, ""), "run", "/wm/learner", 1, "")), 1)
        for iteration in iterations:
            contexts, one = np.array([4], np.uint32), np.array([0.5])
            clips = message_type(CLIPS.msgtype)(
                header(iteration, ""), 0, 0, iteration, 0, contexts, 1, 3, "buffer", f"{iteration}", 0.1, 0.1
            )
            scores = message_type(CLIP_SCORES.msgtype)(
                header(iteration, ""), 0, 0, iteration, f"{iteration}", 1, one, ["psnr_db"], one, one,
                np.array([1], np.uint8), "", "", "reference", 0.1,
            )
            for topic, message in ((CLIPS, clips), (CLIP_SCORES, scores)):
                bag.write(names[topic], serialize(message), 2 + iteration)
    return path


def test_a_start_that_was_stopped_before_its_first_score_does_not_hide_the_clips_of_the_others(tmp_path: Path) -> None:
    stopped, sampled = write_clips(tmp_path / "a", []), write_clips(tmp_path / "b", [], CLIPS, CLIP_SCORES)
    trained = write_clips(tmp_path / "c", [0, 1], CLIPS, CLIP_SCORES)
    clips = trained_clips([stopped, sampled, trained], 2)
    assert [(one.iteration, one.contexts.tolist(), one.total.tolist()) for one in clips] == [
        (0, [4], [0.5]), (1, [4], [0.5])
    ]
    with pytest.raises(BagError, match="2 of 2 iterations, from 0 on, have no scored clips"):
        trained_clips([stopped, sampled], 2)
    with pytest.raises(BagError, match="c has no message on /wm/clips/image"):
        list(read_clips(trained, pictures=True))


def test_raw_rewards_and_the_noise_are_in_the_log(tmp_path: Path, network: VideoNetwork) -> None:
    run = VideoRun(network, config(every=0), tmp_path)
    buffer = toy_buffer(network, ROLLOUT)
    raw = {"total": torch.arange(8.0), "tracking": torch.arange(8.0), "object_cm": 10 * torch.arange(8.0)}
    raw["object_cm"][7] = math.nan
    scored = replace(buffer.with_rewards({"total": raw["total"]}), rewards=raw)
    run.train(scored)
    run.close()
    (line,) = read_metrics(tmp_path, "grpo")
    assert (line["reward_mean"], line["reward_tracking"], line["reward_object_cm"]) == (3.5, 3.5, 30.0)
    shares = buffer.rollout.noise_share.tolist()
    assert line["noise_share"] == pytest.approx(math.sqrt(sum(share**2 for share in shares) / 5)) and len(shares) == 5


def test_without_an_evaluation_setting_nothing_is_asked(tmp_path: Path, network: VideoNetwork) -> None:
    heldout = Falling(network)
    run = VideoRun(network, config(every=0), tmp_path, heldout=heldout)
    train(run, [1, 2])
    run.close()
    assert not heldout.seen and not read_metrics(tmp_path, "heldout")


def test_old_versions_are_deleted_and_the_newest_one_is_scored(tmp_path: Path, network: VideoNetwork) -> None:
    assert progress(tmp_path) == (0, 0), "no checkpoint is no progress"
    heldout = Falling(network)
    run = VideoRun(network, config(), tmp_path, keep_versions=2, heldout=heldout)
    train(run, [1, 2, 3])
    run.close()
    assert progress(tmp_path) == (6, 3)
    names = {path.name for path in (tmp_path / "video_policies").iterdir()}
    assert names == {f"video_00000{version}.safetensors" for version in (4, 6)}
    own = tiny_network(seed=1)
    load_weights(own, (tmp_path / VIDEO_FILES.uri(6)).read_bytes())
    for name, value in weights(own).items():
        assert torch.equal(value, weights(network)[name]) and torch.equal(value, heldout.seen[-1][name])


def test_a_skipped_buffer_is_counted_in_the_log_and_a_resumed_run_goes_on_alike(tmp_path: Path) -> None:
    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    settings = config(every=0)
    for folder, restart in ((straight, False), (stopped, True)):
        run = VideoRun(tiny_network(), settings, folder)
        train(run, [1])
        equal = toy_buffer(run.network, ROLLOUT, version=run.version, iteration=run.iterations)
        report = run.train(equal.with_rewards({"total": torch.full((8,), 0.3)}))
        assert not report.updates and (run.version, run.iterations) == (2, 2)
        if restart:
            run.close()
            run = VideoRun(tiny_network(seed=4), settings, folder)
        assert (run.version, run.iterations, run.learner.skipped) == (2, 2, 1)
        train(run, [2])
        run.close()
    assert [line["skipped"] for line in read_metrics(stopped, "grpo")] == [0, 1, 0]
    assert "kl_1" not in read_metrics(stopped, "grpo")[1] and read_metrics(stopped, "grpo")[1]["kept"] == 0
    assert progress(straight) == progress(stopped) == (4, 3)
    assert (straight / VIDEO_FILES.uri(4)).read_bytes() == (stopped / VIDEO_FILES.uri(4)).read_bytes()


def test_what_the_check_of_a_run_raises_ends_a_training_with_nothing_changed(tmp_path: Path) -> None:
    run = VideoRun(tiny_network(), config(), tmp_path)
    before, calls = weights(run.network), list[int]()

    def check() -> None:
        calls.append(1)
        if len(calls) == 2:  # the first optimizer step is made
            raise InterruptedError("stopped by the user")

    buffer = toy_buffer(run.network, ROLLOUT).with_rewards({"total": torch.arange(8.0)})
    run.check = check
    with pytest.raises(InterruptedError, match="stopped by the user"):
        run.train(buffer)
    assert (run.version, run.iterations) == (0, 0) and all(
        torch.equal(value, before[name]) for name, value in weights(run.network).items()
    )
    run.check = lambda: None
    assert run.train(buffer).updates and run.iterations == 1
    run.close()
