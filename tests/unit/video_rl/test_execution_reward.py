"""The reward of clips by the action world model: on real recordings, on paths worked by hand, and what is refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from wm_nodes.config.load import ConfigError, load_config, load_video_config
from wm_nodes.config.seed_ranges import HELDOUT
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.tasks import success
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.specs import EnvironmentSpec, SpecMismatch, spec_of_values
from wm_nodes.environments.record import collect_plan, scripted_plan
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import VideoFolder, load_video_folder
from wm_nodes.video_rl.execution_reward import (
    EXECUTION_SCORES,
    ExecutionReward,
    check_execution,
    check_followable,
    make_execution_reward,
)
from wm_nodes.video_rl.reference_reward import load_probe
from wm_nodes.video_rl.sampling import RecordedContexts
from wm_nodes.world_model import load_model_folder
from wm_nodes.world_model.folder import read_world_manifest
from wm_nodes.world_model.positions import columns_of

WORLD = shipped_model("push_cube")
SPEC = spec_of_values(read_world_manifest(WORLD)["spec"])
TOOL = slice(4, 7)
"""Of the ground truth of the table top."""


class FirstPixels:
    """Reads the positions that a test wrote into the first pixels of a frame, in mm beyond -0.1 m."""

    def read(self, frames: torch.Tensor) -> np.ndarray[Any, np.dtype[np.float32]]:
        values = frames[..., 0, :7, 0].float().numpy() * 0.004 - 0.5
        return np.asarray(values, np.float32)


class ObjectsPixels(FirstPixels):
    """The same for the positions of the tasks with poses, the tool of which comes after the object's."""

    def read(self, frames: torch.Tensor) -> np.ndarray[Any, np.dtype[np.float32]]:
        values, tool = super().read(frames), columns_of("push", "tool")
        placed = np.zeros((*values.shape[:-1], max(tool) + 1), np.float32)
        placed[..., tool] = values[..., 2:5]
        return placed


class Plain:
    """A codec that changes nothing."""

    def encode(self, frames: torch.Tensor) -> torch.Tensor:
        return frames

    decode = encode


def config_of(**changes: Any) -> VideoRlConfig:
    return load_video_config("outcome", {"rewards": {"execution": 1.0}, **changes})


def folder_of(**clip: int) -> VideoFolder:
    shipped = load_video_folder(WORLD / "video_model_outcome")
    return replace(shipped, codec=Plain(), clip={**shipped.clip, **clip})  # type: ignore[arg-type]


def written(tool: np.ndarray[Any, Any]) -> torch.Tensor:
    """Frames (N, F, 64, 128, 3) in which FirstPixels reads these places of the tool (N, F, 3), to 4 mm."""
    frames = torch.zeros(*tool.shape[:2], 64, 128, 3, dtype=torch.uint8)
    frames[..., 0, 2:5, 0] = torch.from_numpy(((tool + 0.5) / 0.004).round().clip(0, 255)).to(torch.uint8)
    return frames


def walks(count: int = 12, step_m: float = 0.02) -> Clips:
    """Recordings whose tool goes straight ahead by step_m from frame to frame; its state is 0.6 m further."""
    rng = np.random.default_rng(0)
    truth = np.zeros((count, 9, 11), np.float32)
    truth[..., TOOL] = rng.uniform(-0.1, 0.1, (count, 1, 3)) + np.arange(9)[:, None] * (step_m, 0, 0)
    truth[..., TOOL] = (truth[..., TOOL] / 0.004).round() * 0.004
    states = truth[..., TOOL] + np.float32([0.6, 0, 0])
    actions = torch.zeros(count, 8, 6)
    return Clips(
        written(truth[..., TOOL]), actions, truth, ("push",) * count, "push_cube", tuple(range(count)), states, SPEC
    )


def made(recordings: Clips, **clip: int) -> ExecutionReward:
    probe: Any = FirstPixels()
    return ExecutionReward(load_model_folder(WORLD), folder_of(**clip), recordings, probe)


def load(recordings: Clips, **changes: Any) -> ExecutionReward | None:
    probe: Any = FirstPixels()
    return RecordedContexts(folder_of(), recordings, config_of(**changes), probe).execution


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Clips:
    """Scripted episodes of the simulator that no model has seen."""
    scene = load_config("cpu", {"task": "push_cube", "data.num_workers": 1})
    return load_clips(collect_plan(scripted_plan(scene, 40, HELDOUT), scene, tmp_path_factory.mktemp("bags")), 2)


@pytest.mark.rendering
def test_recordings_are_paid_by_how_they_ended_and_not_at_all_for_the_motion_of_another_scene(recorded: Clips) -> None:
    folder, probe = load_video_folder(WORLD / "video_model_outcome"), load_probe(WORLD)
    reward = make_execution_reward(config_of(), folder, recorded, probe)
    shown = folder.codec.decode(folder.codec.encode(recorded.frames))
    done = torch.from_numpy(success("push_cube", recorded.ground_truth[:, -1]))
    own = reward.score(shown, recorded)
    paid, unpaid = own["execution"][done], own["execution"][~done]
    assert len(paid) >= 6 and (paid[:, None] > unpaid).float().mean() > 0.85, "recordings are told apart by chance"
    assert own["execution_success"][done].mean() > 0.6 > 0.2 > own["execution_success"][~done].mean()
    other = reward.score(shown.roll(1, 0), recorded)
    assert other["execution_success"].mean() < 0.1, "a motion of another scene does the task"
    again = reward.score(shown, recorded)
    assert all(torch.equal(own[name], again[name]) and own[name].dtype == torch.float64 for name in EXECUTION_SCORES)


@pytest.mark.rendering
def test_the_reward_is_mixed_with_others_by_its_weight_and_only_the_first_frame_of_a_recording_is_seen(
    recorded: Clips
) -> None:
    folder, probe = load_video_folder(WORLD / "video_model_outcome"), load_probe(WORLD)
    config = config_of(**{"rewards": {"execution": 1.0, "outcome": 0.3}, "groups.contexts": 2, "groups.group_size": 2})
    source = RecordedContexts(folder, recorded, config, probe)
    request = source.request(0, 0)
    buffer = source.score(request, source.sample(request))
    execution, outcome = (buffer.rewards[name] for name in ("execution", "outcome"))
    assert torch.equal(buffer.rewards["total"], execution + 0.3 * outcome) and execution.std() > 0
    reward, references = source.execution, source.references(request)
    assert reward is not None
    frames = folder.codec.decode(buffer.rollout.latents)
    later = references.frames.clone()
    later[:, 1:] = 0
    blind = replace(references, frames=later, ground_truth=np.full_like(references.ground_truth, np.nan))
    assert torch.equal(reward.score(frames, blind)["execution"], execution)
    plain = RecordedContexts(folder, recorded, config.with_values(rewards={"outcome": 1.0}), probe)
    assert plain.execution is None and "execution" not in plain.score(request, buffer).rewards


def test_a_path_begins_at_the_recorded_state_and_a_jump_is_cut_to_the_arms_reach() -> None:
    clips = walks()
    reward = made(clips)
    assert reward.reach_m == pytest.approx(0.02, abs=1e-6)
    np.testing.assert_allclose(reward.correction, [*np.eye(3), [0.6, 0, 0]], atol=2e-3)
    np.testing.assert_allclose(reward.paths(clips.frames, clips), clips.states, atol=3e-3)
    jump = clips.ground_truth[..., TOOL].copy()
    jump[:, 4:] += (0, 0.1, 0)
    paths = reward.paths(written(jump), clips)
    assert np.linalg.norm(np.diff(paths, axis=1), axis=-1).max() <= reward.reach_m + 1e-6
    np.testing.assert_allclose(paths[:, 0], clips.states[:, 0])
    assert (paths[:, 4, 1] - paths[:, 3, 1] > 0.015).all(), "the arm goes to where the jump ended"
    assert (paths[:, -1, 0] - paths[:, 0, 0] < 0.155).all(), "the jump cost nothing"


def test_more_clips_than_are_followed_at_a_time_have_the_scores_of_their_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    clips = walks(10)
    reward = made(clips)
    monkeypatch.setattr("wm_nodes.video_rl.execution_reward.ROWS", 5)
    whole = reward.score(clips.frames, clips)["execution"]
    parts = [clips.select(torch.arange(i, i + 5)) for i in (0, 5)]
    assert torch.equal(whole, torch.cat([reward.score(part.frames, part)["execution"] for part in parts]))
    assert whole.shape == (10,) and whole.std() > 0


def spec(**changes: Any) -> EnvironmentSpec:
    return replace(SPEC, **changes)


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"cameras": ("front", "wrist")}, r"cameras \('front', 'wrist'\), .* was trained with \('side', 'wrist'\)"),
        ({"control_period_s": 0.1}, r"control_period_s 0.1, .* was trained with 0.2.*name another execution.model"),
        ({"state_names": ("a", "b", "c")}, r"state_names .*it is another robot"),
    ],
)
def test_recordings_of_another_environment_than_the_action_models_are_refused(
    other: dict[str, Any], words: str
) -> None:
    with pytest.raises(SpecMismatch, match=words):
        load(replace(walks(), spec=spec(**other)))


def test_a_model_of_other_tasks_and_an_arm_that_a_place_does_not_command_are_refused() -> None:
    with pytest.raises(ValueError, match=r"knows the tasks move_to_aim, .*, not 'push_cube'; name another"):
        load(walks(), **{"execution.model": str(shipped_model("pick_place"))})
    joints = spec(action_names=("a", "b"), action_scale=(1.0, 1.0), action_units=("rad", "rad"))
    with pytest.raises(ValueError, match=r"is commanded by a, b from .*weigh another reward"):
        check_followable(joints, walks())


def pose_walks(gripper: float) -> Clips:
    """The same of an arm that is commanded by poses, whose gripper ends at this value."""
    clips, objects = walks(), read_world_manifest(shipped_model("push"))
    spec = spec_of_values(objects["spec"])
    states = np.zeros((*clips.states.shape[:2], spec.tool_dim), np.float32)
    states[..., :3], states[..., 5], states[..., 6] = clips.states, 0.3, -1.0
    states[:, -1, 6] = gripper
    truth = np.zeros((*clips.ground_truth.shape[:2], len(objects["spec"]["ground_truth_names"])), np.float32)
    tool = objects["spec"]["ground_truth_names"].index("tool_x")
    truth[..., tool : tool + 3] = clips.ground_truth[..., TOOL]
    return replace(
        clips, states=states, ground_truth=truth, task="push", spec=spec,
        actions=torch.zeros(len(states), 8, 14),
    )


def test_an_arm_that_is_commanded_by_poses_keeps_its_rotation_and_its_gripper() -> None:
    clips, models = pose_walks(gripper=-1.0), load_model_folder(shipped_model("push"))
    probe: Any = ObjectsPixels()
    reward = ExecutionReward(models, folder_of(), clips, probe)
    paths = reward.paths(clips.frames, clips)
    np.testing.assert_allclose(paths, clips.states[..., :3], atol=3e-3)
    steps = list(reward.follow(paths, clips))
    assert len(steps) == 2 * (paths.shape[1] - 1)
    for step in steps:
        assert not step.actions_NA[:, 3:6].any() and (step.actions_NA[:, 6] == -1).all()
    reached = steps[-1].arm.states_NP.numpy()
    np.testing.assert_allclose(reached[:, :3], paths[:, -1], atol=1e-3)
    np.testing.assert_allclose(reached[:, 3:7], clips.states[:, 0, 3:7], atol=1e-5)


def test_a_task_whose_gripper_opens_or_closes_is_refused_before_anything_is_made() -> None:
    with pytest.raises(ValueError, match=r"in 12 of 12 recordings of push the gripper opens or closes"):
        check_execution(load_video_config("outcome", {"task": "push"}), pose_walks(gripper=1.0))


def test_clips_that_do_not_begin_with_a_recorded_frame_and_its_state_are_refused() -> None:
    clips = walks()
    with pytest.raises(ValueError, match=r"from a recorded frame; set model.num_conditioning 1"):
        made(clips, num_conditioning=0)
    with pytest.raises(ValueError, match="recordings with simulator state"):
        made(replace(clips, ground_truth=np.full_like(clips.ground_truth, np.nan)))
    astray = clips.states.copy()
    astray[3, 0, 1] += 0.05
    with pytest.raises(ValueError, match=r"recording 3 begins 5.0 cm from where its first state has the tool"):
        made(replace(clips, states=astray))
    with pytest.raises(ConfigError, match=r"set rewards.execution 0, or groups.history 0"):
        load_video_config("closed_loop", {"rewards": {"execution": 1.0}})


def test_without_weight_no_model_is_looked_for(tmp_path: Path) -> None:
    assert load(walks(), **{"rewards": {"outcome": 1.0}, "execution.model": str(tmp_path / "nowhere")}) is None
    with pytest.raises(ValueError, match="nowhere"):
        load(walks(), **{"execution.model": str(tmp_path / "nowhere")})
