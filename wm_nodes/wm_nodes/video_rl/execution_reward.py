"""The reward `execution` (DD-34): whether the task gets done when the action world model follows a clip's tool path.

Shapes: N clips, E recordings, F frames, H W 3 image, P positions. Places of the tool are those of commanded states, m.
No simulator is asked, and nothing is known of how the recording of a clip's context ended. An arm that is commanded by
poses keeps rotation and gripper of its first state: a clip's tool path says nothing of them.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import EXECUTION
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.specs import MODEL_FIELDS, EnvironmentSpec, agree, tool_spec
from wm_nodes.core.tool_control import hold_actions, moves_pose
from wm_nodes.core.types import FloatArray
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.world_model import DeviceEnvironment, WorldModels, load_model_folder
from wm_nodes.world_model.folder import model_spec, read_world_manifest
from wm_nodes.world_model.imagined_episodes import imagined_spec
from wm_nodes.world_model.position_probe import PositionProbe
from wm_nodes.world_model.positions import columns_of, probe_targets

EXECUTION_SCORES = (EXECUTION, f"{EXECUTION}_success")
"""What ExecutionReward.score gives."""
REACH_QUANTILE = 0.99
"""Of the recorded tool's steps from frame to frame: what is longer is beyond the arm's reach."""
START_ERROR_M = 5e-3
"""Most by which a recording's first commanded state may differ from where its tool is."""
ROWS = 256
"""Clips that are followed at a time."""
PLACE = slice(0, 3)
"""The tool's place in a commanded state, and its translation in an action."""
GRIPPER, MOST_GRASPING = 6, 0.2
"""The gripper in a commanded state of a pose; the largest share of recordings in which it may move."""
DECIMALS = 6
"""Of the correction: libraries differ in the last bits of a least-squares solution."""


def make_execution_reward(
    config: VideoRlConfig, folder: VideoFolder, recordings: Clips, probe: PositionProbe
) -> "ExecutionReward":
    """Return the reward of clips of `folder` by the action world model of config.execution.model, or the shipped one of
    the task, on the folder's device.

    Raises:
        ValueError: as check_execution; as ExecutionReward.
    """
    models = load_model_folder(check_execution(config, recordings), folder.device)
    return ExecutionReward(models, folder, recordings, probe)


def check_execution(config: VideoRlConfig, recordings: Clips) -> Path:
    """Return the folder of the action world model that follows clips. It reads only the model's manifest.

    Raises:
        ValueError: the model does not fit the recordings; as check_followable.
    """
    model_dir = Path(config.execution.model) if config.execution.model else shipped_model(config.task)
    manifest = read_world_manifest(model_dir)
    if recordings.task not in manifest["tasks"]:
        raise ValueError(f"{model_dir} knows the tasks {', '.join(manifest['tasks'])}, not {recordings.task!r}; name "
                         "another execution.model")
    spec = model_spec(model_dir, manifest)
    remedy = "name another execution.model, or draw contexts from recordings that this one was trained with"
    agree(tool_spec(recordings.spec), spec, f"{model_dir} was trained with", MODEL_FIELDS, simulated=remedy)
    check_followable(spec, recordings)
    return model_dir


class FollowedStep(NamedTuple):
    """A step of N paths that an action world model follows."""

    actions_NA: Tensor
    """float32 (N, A) in [-1, 1], what was commanded."""
    signal_N: Tensor
    """float32 (N,), the done signal after it."""
    arm: DeviceEnvironment
    """What is shown after it; changes in place with the next step."""


class ExecutionReward:
    """Follows clips in an action world model.

    Attributes:
        correction: see fit_tool_correction, to places of commanded states. reach_m: the longest step of the tool from
            frame to frame. threshold: the done signal above which the task counts as done.

    Args:
        models: of the environment of the recordings, see check_execution.
        folder: its codec and clip; its network is not used.
        recordings: of contexts, with simulator state; correction and reach are measured on them.
        probe: reads positions off decoded clips.

    Raises:
        ValueError: clips without a given frame, recordings without simulator state, or one that does not begin where
            its state says.
    """

    def __init__(self, models: WorldModels, folder: VideoFolder, recordings: Clips, probe: PositionProbe) -> None:
        if folder.clip["num_conditioning"] < 1:
            raise ValueError("the reward execution follows clips from a recorded frame; set model.num_conditioning 1")
        self._models, self._probe, self._stride = models, probe, folder.clip["stride"]
        self._task, self._tool = recordings.task, columns_of(recordings.task, "tool")
        places = _commanded_places(recordings, self._tool)
        seen = probe.read(folder.codec.decode(folder.codec.encode(recordings.frames)))[..., self._tool]
        self.correction = fit_tool_correction(seen, places).round(DECIMALS)
        steps = np.linalg.norm(np.diff(places, axis=1), axis=-1)
        self.reach_m = float(np.quantile(steps[np.isfinite(steps)], REACH_QUANTILE))
        self._reward = load_config("cpu", {"task": self._task, "reward.uncertainty_limit": 0.0}).reward
        self.threshold = self._reward.success_threshold

    def score(self, frames: Tensor, references: Clips) -> dict[str, Tensor]:
        """Return by name, float64 (N,), of decoded clips, uint8 (N, F, H, W, 3): `execution`, the highest done signal
        on the way; `execution_success`: 1 where it is above the threshold.

        references: the recordings that the clips begin with.
        """
        paths = self.paths(frames, references)
        signal = torch.cat([
            self._highest_signal(paths[i : i + ROWS], references.select(torch.arange(i, min(i + ROWS, len(paths)))))
            for i in range(0, len(paths), ROWS)
        ])
        return dict(zip(EXECUTION_SCORES, (signal, (signal > self.threshold).double()), strict=True))

    def paths(self, frames: Tensor, references: Clips) -> FloatArray:
        """Return tool paths (N, F, 3) of decoded clips that the arm can follow: from its first state it goes to the
        place that each frame shows, as far as reach_m."""
        seen = self._probe.read(frames)[..., self._tool]
        places = seen @ self.correction[:3] + self.correction[3]
        places[:, 0] = references.first_states()[:, PLACE]
        for now in range(1, places.shape[1]):
            step = places[:, now] - places[:, now - 1]
            length = np.linalg.norm(step, axis=-1, keepdims=True)
            places[:, now] = places[:, now - 1] + step * np.minimum(1, self.reach_m / np.maximum(length, self.reach_m))
        paths: FloatArray = places.astype(np.float32)
        return paths

    def spec(self, num_frames: int) -> EnvironmentSpec:
        """Return what the clips of so many frames are followed in, as one environment."""
        steps = self._stride * (num_frames - 1)
        spec = replace(self._models.spec, task=self._task, max_episode_steps=steps)
        return imagined_spec(spec, f"wm/{self._task}", self._models.sha256, 1)

    def follow(self, paths: FloatArray, references: Clips) -> Iterator[FollowedStep]:
        """Command paths (N, F, 3) on straight lines between frames, without an early end; a step is given as soon as it
        is imagined. references: the recordings that the paths begin with."""
        count, spec = len(paths), self.spec(paths.shape[1])
        starts = references.frames[:, 0].cpu().numpy(), references.first_states()
        endless = self._reward.with_values(success_threshold=1.0)
        arm = DeviceEnvironment(self._models, spec, starts, endless, num_envs=count, with_goals=False)
        arm.reset(torch.ones(count, dtype=torch.bool, device=arm.device), torch.arange(count, device=arm.device))
        path = torch.from_numpy(paths).to(arm.device)
        scale = torch.tensor(spec.action_scale[PLACE], device=arm.device)
        kept = torch.from_numpy(hold_actions(references.first_states(), spec)).to(arm.device)
        for step in range(spec.max_episode_steps):
            frame, share = step // self._stride, (step % self._stride + 1) / self._stride
            target = path[:, frame] + share * (path[:, frame + 1] - path[:, frame])
            moves = ((target - arm.states_NP[:, PLACE]) / scale).clamp(-1, 1)
            actions = torch.cat([moves, kept[:, PLACE.stop :]], 1)
            yield FollowedStep(actions, arm.step(actions).signal_N, arm)
        arm.check_finite()

    @torch.inference_mode()
    def _highest_signal(self, paths: FloatArray, references: Clips) -> Tensor:
        """Return the highest done signal of each path, float64 (N,)."""
        return torch.stack([step.signal_N for step in self.follow(paths, references)]).amax(0).double().cpu()


def check_followable(spec: EnvironmentSpec, recordings: Clips) -> None:
    """Raise ValueError unless a tool path says what an environment is commanded by to do what was recorded."""
    pose = moves_pose(spec)
    commanded = [i for i in range(spec.tool_dim) if i not in spec.measured] == [*range(spec.action_dim)]
    if not commanded or len(columns_of(recordings.task, "tool")) != 3 or not (pose or spec.action_dim == 3):
        raise ValueError(
            f"the reward execution follows a tool's place in three coordinates, and {spec.env_id} is commanded by "
            f"{', '.join(spec.action_names)} from {', '.join(spec.state_names[: spec.tool_dim])}; weigh another reward"
        )
    if pose:
        moved = np.ptp(recordings.states[..., GRIPPER], axis=1) > 0
        if moved.mean() > MOST_GRASPING:
            raise ValueError(
                f"the reward execution follows a tool's place, and in {moved.sum()} of {len(moved)} recordings of "
                f"{recordings.task} the gripper opens or closes, which no place says; weigh another reward"
            )


def _commanded_places(recordings: Clips, tool: list[int]) -> FloatArray:
    """Return where the tool is in recordings, (E, F, 3), in the frame of commanded states: at a reset it is where the
    first one says. NaN where no simulator state is known."""
    truth = probe_targets(recordings.ground_truth, recordings.task)[..., tool]
    apart = recordings.first_states()[:, PLACE] - truth[:, 0]
    known = np.isfinite(apart).all(1)
    if not known.any():
        raise ValueError("the reward execution needs recordings with simulator state, by which the reading of the tool "
                         "is corrected; weigh closeness, or record the state")
    offset = np.median(apart[known], axis=0)
    astray = known & (np.abs(apart - offset).max(1) > START_ERROR_M)
    if astray.any():
        row = int(astray.argmax())
        raise ValueError(
            f"recording {row} begins {100 * np.linalg.norm(apart[row] - offset):.1f} cm from where its first state has "
            "the tool; an action world model starts from the state: leave this recording out"
        )
    places: FloatArray = truth + offset
    return places


def fit_tool_correction(positions: FloatArray, truth: FloatArray) -> NDArray[np.float64]:
    """Return the least-squares map (4, 3) from tool positions that the probe reads in decoded recordings to the true
    ones, both (N, F, 3), with an offset in the last row. Raises ValueError where no true one is known.

    A codec may make the tool look lower than it is: a shipped one does, by 1.1 cm on average and by
    2.3 cm at heights above 12 cm. Uncorrected, paths that pass over the object touch it when they are executed.
    """
    seen, wanted = (values.reshape(-1, 3).astype(np.float64) for values in (positions, truth))
    known = np.isfinite(wanted).all(1)
    if not known.any():
        raise ValueError("the recordings have no simulator state")
    seen = np.column_stack([seen[known], np.ones(known.sum())])
    found: NDArray[np.float64] = np.linalg.lstsq(seen, wanted[known], rcond=None)[0]
    return found
