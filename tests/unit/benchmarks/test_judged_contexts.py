"""The reward agent as the reward of clips in one process; and what each rubric makes of real clips."""

import asyncio
import functools
import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from graph.video_loop import STRIDE, make_video_folder, settings, write_contexts
from recording_samples import make_spec
from torch.testing import assert_close
from video_toys import changed_judge, far_sighted_judge

from benchmarks.video_rl.judged import JudgedContexts, open_judge
from wm_nodes.config.load import load_config, load_video_config
from wm_nodes.config.seed_ranges import NEW_CONTEXTS
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.types import UInt8Array
from wm_nodes.environments.maniskill.table_top import GROUND_TRUTH_NAMES
from wm_nodes.environments.record import collect_plan, scripted_plan
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.precheck import precheck
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.backends.one_class import OneClassJudge
from wm_nodes.judge.service import ClipJob, TrainingPaused, buffer_jobs
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import load_video_folder
from wm_nodes.video_model.tokenizer_codec import codec_of_world_model
from wm_nodes.video_rl.grpo import GrpoLearner
from wm_nodes.video_rl.reference_reward import load_probe
from wm_nodes.video_rl.train import post_train, sample_buffers

MODEL_DIR, FPS = shipped_model("push_cube"), 2.5
HIDDEN = {"groups.hide_actions": True, "model.training.hide_actions": 0.5}


@pytest.fixture
def given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Clips, dict[str, Any]]:
    """An untrained video model, recorded contexts, and settings that judge its clips."""
    spec = functools.partial(make_spec, instruction="push the cube into the target")
    monkeypatch.setattr("graph.video_loop.make_spec", spec)
    contexts = load_clips([write_contexts(tmp_path / "bag")], STRIDE)
    folder = load_video_folder(make_video_folder(tmp_path / "video", contexts))
    judge = {"judge.kind": "embedded", "judge.folder": str(far_sighted_judge(tmp_path / "judge"))}
    return folder, contexts, {"rollout.num_steps": 4, "window.size": 2, **judge}


def test_the_agents_reward_is_mixed_with_others_and_is_what_the_service_says_of_the_same_jobs(given: Any) -> None:
    folder, contexts, values = given
    config = settings(**values, **HIDDEN, rewards={"agent": 1.0, "psnr_db": 0.5})
    with JudgedContexts(folder, contexts, config, load_probe(MODEL_DIR), FPS) as source:
        request = source.request(0, 0)
        clips = source.sample(request)
        found, again = source.score(request, clips), source.score(request, clips)
        references, frames = source.references(request), folder.codec.decode(clips.rollout.latents)
        jobs = buffer_jobs(frames, references, hashlib.sha256(clips.to_bytes()).hexdigest(), config, given=1, fps=FPS)
        judge = open_judge(config, contexts, FPS)
        alone = judge.judge(jobs)
        judge.close()
    assert [verdict.audit_id for verdict in source.verdicts] == [verdict.audit_id for verdict in alone]
    assert found.rewards["agent"].tolist() == [verdict.reward for verdict in alone] == again.rewards["agent"].tolist()
    assert len(set(found.rewards["agent"].tolist())) > 1
    assert_close(found.rewards["total"], found.rewards["agent"] + 0.5 * found.rewards["psnr_db"], equal_nan=True)
    learner = GrpoLearner(folder.network, config.grpo, config.rollout, seed=config.seed)
    with JudgedContexts(folder, contexts, config, load_probe(MODEL_DIR), FPS) as source:
        (buffer, report), = post_train(learner, sample_buffers(source, learner, 1))
    assert torch.equal(buffer.rewards["total"].nan_to_num(), found.rewards["total"].nan_to_num())
    assert report.reward_mean == pytest.approx(float(found.rewards["total"].mean()))


def test_the_preset_outcome_trains_on_half_outcome_and_half_agent(given: Any) -> None:
    folder, contexts, values = given
    contexts.ground_truth[..., GROUND_TRUTH_NAMES.index("goal_x")] = 0.3  # no clip reaches it
    config = load_video_config("outcome", {
        **values, "rewards": {"outcome": 0.5, "agent": 0.5}, "groups.contexts": 2, "groups.group_size": 4,
    })
    before = {name: value.clone() for name, value in folder.network.state_dict().items()}
    learner = GrpoLearner(folder.network, config.grpo, config.rollout, seed=config.seed)
    with JudgedContexts(folder, contexts, config, load_probe(MODEL_DIR), FPS) as source:
        (buffer, report), = post_train(learner, sample_buffers(source, learner, 1))
    rewards = buffer.rewards
    assert_close(rewards["total"], (rewards["outcome"] + rewards["agent"]) / 2, equal_nan=True)
    assert all(rewards[name][buffer.valid].std() > 0 for name in config.rewards) and buffer.valid.sum() >= 4
    assert learner.version == 1 and report.kept > 0
    assert any(not torch.equal(value, before[name]) for name, value in folder.network.state_dict().items())


def test_recorded_actions_are_not_what_a_clip_of_hidden_actions_should_show(given: Any) -> None:
    _, contexts, values = given
    still = contexts.frames[:2, :1].expand_as(contexts.frames[:2]).clone()
    moved = Clips(
        contexts.frames[:2], torch.ones_like(contexts.actions[:2]), contexts.ground_truth[:2],
        contexts.instructions[:2], contexts.task, contexts.seeds[:2], contexts.states[:2], contexts.spec,
    )

    def jobs(**changes: Any) -> list[ClipJob]:
        return buffer_jobs(still, moved, "0" * 64, settings(**values, **changes), given=1, fps=FPS)

    assert [precheck(job.clip, job.task).kind for job in jobs()] == ["no video"] * 2
    assert [precheck(job.clip, job.task).kind for job in jobs(**HIDDEN)] == ["ok"] * 2
    assert all(job.task.actions is None and job.task.task_id == "push_cube" for job in jobs(**HIDDEN))


def test_without_weight_nobody_is_asked_and_a_round_without_verdicts_pauses(given: Any, tmp_path: Path) -> None:
    folder, contexts, values = given
    foreign = {"judge.kind": "embedded", "judge.folder": str(changed_judge(tmp_path / "long", lengths=(40, 50)))}
    with pytest.raises(ValueError, match="cannot judge clips of 3 frames, 64 x 128 px"):
        JudgedContexts(folder, contexts, settings(**foreign, rewards={"agent": 1.0}), load_probe(MODEL_DIR), FPS)
    with JudgedContexts(folder, contexts, settings(**foreign), load_probe(MODEL_DIR), FPS) as source:
        request = source.request(0, 0)
        assert "agent" not in source.score(request, source.sample(request)).rewards and source.verdicts == ()
    strict = settings(**values, **{"rewards": {"agent": 1.0}, "judge.clip_budget_s": 1e-9})
    with JudgedContexts(folder, contexts, strict, load_probe(MODEL_DIR), FPS) as source:
        request = source.request(0, 0)
        with pytest.raises(TrainingPaused, match="6 of 6 verdicts are invalid"):
            source.score(request, source.sample(request))


PACKS = ("robot", "robot_no_physics", "robot_no_planning", "robot_single_read", "robot_open_gates")


@pytest.fixture(scope="module")
def verdicts(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], Verdict]:
    """What each pack says of recordings as the tokenizer draws them: a success, a failure, and the success with its
    cube painted away in the last frames; by kind of clip and pack."""
    scene = load_config("cpu", {"task": "push_cube", "data.num_workers": 1})
    clips = dict[str, tuple[UInt8Array, Clips]]()
    for name, seed in (("success", 250_015), ("failure", 250_002)):
        plan = replace(scripted_plan(scene, 1, NEW_CONTEXTS), first_seed=seed)
        bags = collect_plan(plan, scene, tmp_path_factory.mktemp(name) / "bags")
        recorded, codec = load_clips(bags, 2), codec_of_world_model(MODEL_DIR)
        clips[name] = codec.decode(codec.encode(recorded.frames))[0].numpy(), recorded
    frames, recorded = clips["success"]
    clips["vanished"] = np.concatenate([frames[:-3], [without_blue(frame) for frame in frames[-3:]]]), recorded
    judge = OneClassJudge(MODEL_DIR)
    return {
        (name, pack): asyncio.run(RewardAgent(judge, load_rubric(pack)).evaluate(job.clip, job.task))
        for name, (shown, source) in clips.items()
        for job in buffer_jobs(
            torch.from_numpy(shown)[None], source, "0" * 64, load_video_config("outcome"), given=1, fps=FPS
        )
        for pack in PACKS
    }


def without_blue(frame: UInt8Array) -> UInt8Array:
    red, green, blue = np.moveaxis(frame.astype(int), 2, 0)
    cube = cv2.dilate(((blue > red + 25) & (blue > green + 10)).astype(np.uint8), np.ones((5, 5)))
    return np.asarray(cv2.inpaint(frame, cube, 3, cv2.INPAINT_TELEA), np.uint8)


@pytest.mark.rendering
def test_a_success_earns_nearly_one_by_every_pack_and_a_failure_less_the_later_its_gate_closes(
    verdicts: dict[tuple[str, str], Verdict]
) -> None:
    assert all(verdict.valid for verdict in verdicts.values())
    assert all(verdicts["success", pack].reward > 0.9 for pack in PACKS)
    fails = {pack: verdicts["failure", pack].reward for pack in PACKS}
    assert not verdicts["failure", "robot"].stages[2].passed
    assert all(reward < 0.85 for reward in fails.values())
    assert fails["robot_single_read"] == fails["robot"], "the embedded judge answers a second question as the first"
    assert fails["robot"] < fails["robot_no_physics"] < fails["robot_open_gates"], fails


@pytest.mark.rendering
def test_without_physics_a_vanished_cube_is_paid_as_if_it_were_there(verdicts: dict[tuple[str, str], Verdict]) -> None:
    whole, hackable = verdicts["vanished", "robot"], verdicts["vanished", "robot_no_physics"]
    assert whole.reward < verdicts["success", "robot"].reward - 0.25
    assert hackable.reward > verdicts["success", "robot_no_physics"].reward - 0.2
    assert any(flag.pattern == "physics" and flag.confirmed for flag in whole.hack_flags)
