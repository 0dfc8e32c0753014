"""What a world model says of a clip of its own cameras: surprise, reconstruction, actions, goal, done (RA-17).

Evidence, trigger and veto, never a score: likelihood alone rewards standing still, so surprise is given beside the
error of a model of "nothing moves", and beside what other actions would have explained. Shapes: T frames, J actions
between two frames, H W 3 image, A action, S state.

The clips of the adversarial benchmark have other cameras and no actions, so the shipped judge does not read these; the
agent does, by a rubric's bands (clip_evidence.py).
"""

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.judge.agent.types import TaskSpec
from wm_nodes.world_model import WorldModels
from wm_nodes.world_model.dynamics import ActionModel, done_signal
from wm_nodes.world_model.tokenizer import PROBE_NAMES, normalise_tokens

BLOCK_PX = 8
TOOL = slice(PROBE_NAMES.index("tool_x"), PROBE_NAMES.index("tool_z") + 1)
MODEL_EVIDENCE = {
    "tokenizer_error": "mean absolute error of encoding and decoding, grey levels; 0 to 255",
    "tokenizer_error_worst": f"the same in the worst {BLOCK_PX} x {BLOCK_PX} block of any frame; 0 to 255",
    "surprise": "mean squared error of the next latents under the action model, given all frames before; >= 0",
    "surprise_max": "the largest of these over time; >= 0",
    "surprise_over_still": "log of surprise over the error of predicting no change; > 0: the model is worse than that",
    "still_energy": "mean squared change of latents per step; about 0 in a frozen clip, which surprise would reward",
    "action_gain": "mean log ratio of the error under reversed actions to that under the given ones; > 0: they fit",
    "tool_error": "mean distance of the tool's read displacement from the commanded one, over the largest step; >= 0",
    "done_end": "done signal of the task on the last frame; 0 to 1",
    "done_max": "its largest value; 0 to 1",
    "done_rise": "share of steps on which it does not fall; 0 to 1",
    "goal_similarity": "1 - mean absolute difference of the last frame's latents from the goal's, over the first's",
    "goal_slope": "least-squares slope of -distance to the goal over normalised time, over the first distance",
}
"""Name -> definition and range. The goal's two are given only where the task has a goal image."""


@torch.inference_mode()
def model_evidence(
    models: WorldModels, frames: UInt8Array, task: TaskSpec, start_state: FloatArray | None = None
) -> dict[str, float]:
    """Return MODEL_EVIDENCE of one clip.

    Args:
        frames: uint8 (T, H, W, 3), T >= 2, in the cameras and size of the models' manifest. task: its actions are in
            [-1, 1], (T - 1, J A): the J actions that move frame t to t + 1, one after the other. Where J > 1 the model
            imagines the frames between.
        start_state: (S,) commanded tool position on frame 0, m, robot base frame, as Observation.state; None: where
            the tokenizer's probe sees the tool on frame 0.

    Raises:
        ValueError: no actions, of another length or size, frames of another size, or a model over discrete tokens.
        ModelFolderError: the models do not know the task.
    """
    action_model = models.action
    if not isinstance(action_model, ActionModel):
        raise ValueError("surprise is defined over continuous latents; take a model with tokenizer.kind continuous")
    action_dim, num_steps = len(models.simulation.workspace_low_m), len(frames) - 1
    given = None if task.actions is None else task.actions.shape
    if given is None or len(given) != 2 or given[0] != num_steps or not given[1] or given[1] % action_dim:
        raise ValueError(f"the world model needs actions ({num_steps}, {action_dim} or a multiple), got {given}")
    per_frame = given[1] // action_dim
    index = models.task_index(task.task_id)
    tokenizer = models.tokenizer
    latents = tokenizer.encode(frames)
    difference = np.abs(tokenizer.decode(latents).cpu().numpy().astype(np.float32) - frames).mean(3)
    blocks = F.avg_pool2d(torch.from_numpy(difference)[:, None], BLOCK_PX)
    read = tokenizer.read_state(latents)[:, TOOL]
    device = latents.device
    actions = torch.from_numpy(np.asarray(task.actions, np.float32)).reshape(-1, action_dim).to(device)
    start = read[0] if start_state is None else torch.from_numpy(np.asarray(start_state, np.float32)).to(device)
    states, turned_states = (commanded_states(models, start, sign * actions) for sign in (1, -1))
    errors, logits = _errors(action_model, latents, actions, states, per_frame)
    turned, _ = _errors(action_model, latents, -actions, turned_states, per_frame)
    still = (latents[1:] - latents[:-1]).square().mean((1, 2))
    signal = F.pad(done_signal(logits)[0][:, index], (1, 0))
    shown = states[::per_frame]
    moved = (read[1:] - read[:-1]) - (shown[1:] - shown[:-1])
    evidence = {
        "tokenizer_error": float(difference.mean()), "tokenizer_error_worst": float(blocks.max()),
        "surprise": float(errors.mean()), "surprise_max": float(errors.max()),
        "surprise_over_still": float(torch.log((errors.mean() + 1e-4) / (still.mean() + 1e-4))),
        "still_energy": float(still.mean()),
        "action_gain": float(torch.log((turned + 1e-4) / (errors + 1e-4)).mean()),
        "tool_error": float(moved.norm(dim=1).mean() / (models.simulation.max_action_m * per_frame)),
        "done_end": float(signal[-1]), "done_max": float(signal.max()),
        "done_rise": float((signal[1:] >= signal[:-1] - 1e-6).float().mean()),
    }
    if task.goal_image is not None:
        evidence |= _goal(latents, tokenizer.encode(task.goal_image[None])[0])
    return evidence


def _errors(
    model: ActionModel, latents_TSD: Tensor, actions_TA: Tensor, states_TS: Tensor, per_frame: int
) -> tuple[Tensor, Tensor]:
    """(T - 1,) mean squared error of each next frame's latents, and done logits (T - 1, heads, tasks)."""
    if per_frame > 1:
        return _imagined_errors(model, latents_TSD, actions_TA, states_TS, per_frame)
    before, after = states_TS[:-1][None], states_TS[1:][None]
    prediction = model(latents_TSD[:-1][None], actions_TA[None], before, after)
    expected = normalise_tokens(latents_TSD[:-1] + prediction.change_BTSD[0])
    return (expected - latents_TSD[1:]).square().mean((1, 2)), prediction.done_logits_BTKJ[0]


def _imagined_errors(
    model: ActionModel, latents_TSD: Tensor, actions_TA: Tensor, states_TS: Tensor, per_frame: int
) -> tuple[Tensor, Tensor]:
    """As _errors: from each frame on, the model goes the actions up to the next one by itself."""
    caches = model.trunk.new_ring_caches(1, latents_TSD.device)
    errors, logits = [], []
    for t, expected_SD in enumerate(latents_TSD[1:]):
        imagined_NSD = latents_TSD[t : t + 1]
        for i in range(t * per_frame, (t + 1) * per_frame):
            row, after = slice(i, i + 1), slice(i + 1, i + 2)
            imagined_NSD, done = model.advance(imagined_NSD, actions_TA[row], states_TS[row], states_TS[after], caches)
        errors.append((imagined_NSD[0] - expected_SD).square().mean())
        logits.append(done[0])
    return torch.stack(errors), torch.stack(logits)


def commanded_states(models: WorldModels, start_S: Tensor, actions_TA: Tensor) -> Tensor:
    """Commanded tool positions (T, S), m: each action moves at most max_action_m, inside the workspace (control.py)."""
    simulation = models.simulation
    low, high = (torch.tensor(edge).to(start_S) for edge in (simulation.workspace_low_m, simulation.workspace_high_m))
    states = [start_S]
    for action in actions_TA:
        moved = states[-1] + simulation.max_action_m * action
        states.append(torch.minimum(torch.maximum(moved, torch.minimum(low, start_S)), torch.maximum(high, start_S)))
    return torch.stack(states)


def _goal(latents_TSD: Tensor, goal_SD: Tensor) -> dict[str, float]:
    distance = (latents_TSD - goal_SD).abs().mean((1, 2))
    first = float(distance[0]) + 1e-6
    time = torch.linspace(-0.5, 0.5, len(distance), device=distance.device)
    slope = float((time * -distance).sum() / time.square().sum())
    return {"goal_similarity": 1 - float(distance[-1]) / first, "goal_slope": slope / first}
