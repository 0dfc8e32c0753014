"""Clips that the action world model accepts as a bag of imagined episodes: what is in it, and that a policy learns from
it; on real recordings, with the shipped models."""

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch

from wm_nodes.apps import cli
from wm_nodes.config.load import dump_config, load_config, load_video_config
from wm_nodes.config.seed_ranges import NEW_CONTEXTS
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.specs import SOURCE_IMAGINED, of_columns
from wm_nodes.core.types import Episode
from wm_nodes.environments.record import collect_plan, scripted_plan
from wm_nodes.policy_rl.factories import make_policy
from wm_nodes.policy_rl.initial_policy import train_weak_policy
from wm_nodes.recording import Bag, BagError, read_episodes, read_spec
from wm_nodes.training.weights import load_weights_file, pack_weights
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import load_video_folder, save_video_folder
from wm_nodes.video_rl.execution_reward import ExecutionReward, make_execution_reward
from wm_nodes.video_rl.followed_episodes import accepted_episodes, sampled_clips, write_followed_episodes
from wm_nodes.video_rl.reference_reward import load_probe
from wm_nodes.world_model.folder import model_spec, read_world_manifest

pytestmark = pytest.mark.rendering

WORLD = shipped_model("push_cube")
FOLDER = load_video_folder(WORLD / "video_model_outcome")
PROBE = load_probe(WORLD)
CONFIG = load_video_config("outcome")


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What train-video-model leaves before its first buffer."""
    run = tmp_path_factory.mktemp("run")
    scene = load_config("cpu", {"task": "push_cube", "data.num_workers": 1})
    collect_plan(scripted_plan(scene, 24, NEW_CONTEXTS), scene, run / "data" / "train")
    save_video_folder(run / "video_model", FOLDER.codec, FOLDER.network, FOLDER.clip, FOLDER.manifest)
    (run / "config.yaml").write_text(dump_config(CONFIG), encoding="utf-8")
    return run


@pytest.fixture(scope="module")
def recordings(run_folder: Path) -> Clips:
    return load_clips(sorted((run_folder / "data" / "train").glob("shard_*")), CONFIG.model.stride)


@pytest.fixture(scope="module")
def reward(recordings: Clips) -> ExecutionReward:
    return make_execution_reward(CONFIG, FOLDER, recordings, PROBE)


@pytest.fixture(scope="module")
def shown(recordings: Clips) -> torch.Tensor:
    return FOLDER.codec.decode(FOLDER.codec.encode(recordings.frames))


@pytest.fixture(scope="module")
def episodes(recordings: Clips, reward: ExecutionReward, shown: torch.Tensor) -> list[Episode]:
    return accepted_episodes(reward, shown, recordings)


def test_an_episode_is_made_of_each_clip_that_the_reward_takes_for_a_success_and_ends_there(
    recordings: Clips, reward: ExecutionReward, shown: torch.Tensor, episodes: list[Episode]
) -> None:
    accepted = reward.score(shown, recordings)["execution_success"].bool()
    assert [episode.seed for episode in episodes] == [recordings.seeds[row] for row in accepted.nonzero().flatten()]
    assert 4 <= len(episodes) < len(recordings) and len({episode.num_steps for episode in episodes}) > 1
    for episode in episodes:
        assert episode.success.tolist() == [False] * episode.num_steps + [True] and episode.terminated
        assert episode.extra["done_signal"] > reward.threshold and episode.source == SOURCE_IMAGINED


def test_it_begins_with_the_recorded_picture_and_its_actions_lead_from_each_state_to_the_next(
    recordings: Clips, reward: ExecutionReward, episodes: list[Episode]
) -> None:
    spec, changes = reward.spec(recordings.frames.shape[1]), list[float]()
    for episode in episodes:
        row = recordings.seeds.index(episode.seed)
        np.testing.assert_array_equal(episode.images[0], recordings.frames[row, 0].numpy())
        np.testing.assert_array_equal(episode.states[0], recordings.first_states()[row])
        moved = (episode.states[:-1] + episode.actions * spec.action_scale).clip(spec.state_low, spec.state_high)
        np.testing.assert_allclose(episode.states[1:], moved, atol=1e-6)
        changes.append(float(np.abs(episode.images[1:].astype(float) - episode.images[:-1]).mean((1, 2, 3)).min()))
    assert min(changes) > 0, "a picture was not imagined"


def test_of_a_recording_only_the_first_picture_and_state_are_seen(
    recordings: Clips, reward: ExecutionReward, episodes: list[Episode], shown: torch.Tensor
) -> None:
    later = recordings.frames.clone()
    later[:, 1:] = 0
    unknown = np.full_like(recordings.ground_truth, np.nan)
    blind = replace(recordings, frames=later, ground_truth=unknown, actions=torch.zeros_like(recordings.actions))
    for first, again in zip(episodes, accepted_episodes(reward, shown, blind), strict=True):
        np.testing.assert_array_equal(first.images, again.images)
        np.testing.assert_array_equal(first.actions, again.actions)
    (own, _), (other, _) = (next(sampled_clips(FOLDER, clips, CONFIG)) for clips in (recordings, blind))
    assert torch.equal(own, other)


def test_the_verb_writes_a_bag_that_says_it_is_imagined_and_a_policy_learns_from_it(
    run_folder: Path, recordings: Clips, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = tmp_path / "bag"
    assert cli.main(["follow-clips", str(run_folder), "--out", str(bag), "--episodes", "3"]) == cli.DONE
    said = capsys.readouterr().out
    assert " clips were accepted; " in said and "3 imagined episodes of push_cube" in said
    spec, model = read_spec(bag), model_spec(WORLD, read_world_manifest(WORLD))
    assert spec.source == SOURCE_IMAGINED and spec.world_model_sha256 and not spec.ground_truth_names
    assert of_columns(spec, range(3)).state_names == model.state_names
    with Bag(bag) as opened:
        assert opened.custom["wm.video_model_sha256"] == pack_weights(FOLDER.network).sha256
        assert {row["behaviour"] for row in opened.episode_table()} == {"followed_clip"}
    episodes = list(read_episodes(bag))
    assert len(episodes) == 3 and {episode.seed for episode in episodes} <= set(recordings.seeds)
    config = load_config("cpu", {"task": "push_cube", "sft.num_demonstrations": 3, "sft.num_iterations": 60})
    policy = train_weak_policy(config, WORLD, [bag], tmp_path / "weak.safetensors", anyone=True)
    fresh = make_policy(config, WORLD)
    images, states, actions = (
        np.concatenate([getattr(episode, name)[: episode.num_steps] for episode in episodes])
        for name in ("images", "states", "actions")
    )
    errors = [np.abs(one.act(images, states).actions - actions).mean() for one in (policy, fresh)]
    assert errors[0] < 0.5 * errors[1], "the policy has not learned the bag's actions"
    load_weights_file(fresh, tmp_path / "weak.safetensors")


def test_clips_that_are_made_of_the_recorded_actions_are_not_followed(tmp_path: Path) -> None:
    given, nothing_is_read = CONFIG.with_values(groups=CONFIG.groups.with_values(hide_actions=False)), cast(Clips, None)
    with pytest.raises(ValueError, match=r"repeat the recorded actions.*--preset outcome \(groups\.hide_actions\)"):
        write_followed_episodes(tmp_path / "bag", FOLDER, nothing_is_read, given, PROBE, 1)
    assert not (tmp_path / "bag").exists()


def test_a_bag_that_is_there_is_kept_and_a_model_none_of_whose_clips_is_accepted_leaves_none(
    run_folder: Path, recordings: Clips, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "kept").mkdir()
    assert cli.main(["follow-clips", str(run_folder), "--out", str(tmp_path / "kept")]) == cli.ERROR
    assert "exists already; choose another name" in capsys.readouterr().err
    with pytest.raises(BagError, match="exists already"):
        write_followed_episodes(tmp_path / "kept", FOLDER, recordings, CONFIG, PROBE, 1)
    reach = "wm_nodes.video_rl.execution_reward.REACH_QUANTILE"
    monkeypatch.setattr(reach, 0.0)  # an arm that cannot move
    with pytest.raises(ValueError, match=r"none of 24 clips is accepted: .* train the video model longer"):
        write_followed_episodes(tmp_path / "none", FOLDER, recordings, CONFIG, PROBE, 1)
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]
