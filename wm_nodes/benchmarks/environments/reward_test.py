"""Figure 3 of RoboScape-R with numbers: which reward tells, in the world model, what succeeds in the simulator?

The actions of simulator episodes are imagined from their first frames; every reward scores the imagined steps, and the
simulator says which episodes succeed. Shapes: E episodes, T steps, F features.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.table import Table
from torch import Tensor, nn

from benchmarks.environments.policies import spearman
from wm_nodes.config.scenes import splits
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.seed_ranges import HELDOUT, NEW_CONTEXTS
from wm_nodes.core.seeding import numpy_stream, torch_stream
from wm_nodes.core.statistics import auroc
from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.environments.record import collect_plan, task_plan
from wm_nodes.judge.agent.contract import MAX_INVALID_SHARE
from wm_nodes.judge.agent.types import TaskSpec, clip_ref
from wm_nodes.judge.episode_reward import episode_judge
from wm_nodes.judge.service import ClipJob, JudgeService
from wm_nodes.policy_rl.factories import make_encoder, models_of
from wm_nodes.recording import read_episodes
from wm_nodes.recording.episode_arrays import EpisodeArrays, stack_episodes
from wm_nodes.reports.console_table import make_table
from wm_nodes.reward import EncoderDistance, EndogenousReward, RewardInput
from wm_nodes.world_model.dynamics import pooled_features
from wm_nodes.world_model.folder import WorldModels
from wm_nodes.world_model.text import ImaginedGoals, imagine_goals
from wm_nodes.world_model.validation.open_loop import BATCH, ImaginedEpisodes, imagine

JUDGE, DONE_VALUE = "reward agent", "done signal, its largest value"
EMPTY_HAND = "no_grasp"
"""The behaviour that moves like a demonstration and never closes the gripper."""
BEHAVIOURS = {"expert": 0.4, EMPTY_HAND: 0.2, "noisy": 0.15, "near_miss": 0.15, "short": 0.1}
TOGETHER = 16
"""Episodes whose frames and golden trajectories the distance keeps in memory."""
DRAWS = 1000
RIDGE = 1.0
PROXY_WIDTH, PROXY_ITERATIONS, PROXY_BATCH = 256, 2000, 256


@dataclass(frozen=True)
class Imagined:
    """Episodes of one domain, as simulated and as imagined."""

    real: EpisodeArrays
    """As recorded."""
    frames: UInt8Array
    """uint8 (E, T + 1, H, W, 3), from the real first frame."""
    signals: FloatArray
    """float32 (E, T), the done signal of the task."""
    uncertainty: FloatArray
    """float32 (E, T)."""
    features: FloatArray
    """float32 (E, T, F), of the world model's last layer, pooled, as its done heads see them."""

    @property
    def won(self) -> NDArray[np.bool_]:
        """(E,), success at any step in the simulator."""
        won: NDArray[np.bool_] = (self.real.success[..., 0] & self.real.frame_mask).any(1)
        return won


def measure_rewards(config: RunConfig, model_dir: Path, learned_from: int, work: Path) -> Iterator[dict[str, Any]]:
    """How well each reward, on imagined steps, tells episodes of config.task that succeed in the simulator from those
    that do not, from an empty hand's alone, and how it grows along a success; for every domain.

    Args:
        learned_from: simulator episodes in training scenes that the learned rewards have seen.
        work: folder of the episodes; what is there is kept.
    """
    models, episodes = models_of(model_dir, config.device), config.evaluation.episodes
    heads = learned_heads(episodes_learned_from(config, models, learned_from, work), model_dir, config.seed)
    for domain in splits():
        found = imagined_episodes(config, models, domain, HELDOUT.take(episodes), episodes, work)
        goals = goals_of(models, found.real, config)
        scored = paid(found, goals, model_dir, config) | {name: head(found) for name, head in heads.items()}
        scored[DONE_VALUE] = largest(found.signals.astype(np.float64), found)
        scored[JUDGE] = judged(found, config)
        for name, values in scored.items():
            yield {"task": config.task, "domain": domain, "reward": name, **judge_reward(values, found, config.seed)}


def rewards_table(rows: Iterable[dict[str, Any]]) -> Table:
    """Of the rows of measure_rewards."""
    columns = ("task", "reward", "scenes", "episodes", "succeed", "AUROC", "95 %", "AUROC, empty hand",
               "rank correlation")
    return make_table("what a reward tells of real success", columns, [
        (row["task"], row["reward"], row["domain"], str(row["episodes_scored"]), str(row["successes"]),
         shown(row["auroc"][0]), " to ".join(map(shown, row["auroc"][1:])), shown(row["auroc_empty_hand"]),
         shown(row["rank_correlation"], "+.2f"))
        for row in rows
    ])


def shown(value: float | None, form: str = ".2f") -> str:
    """A number, or what is written where there is none: no episode, or none of one kind."""
    return "-" if value is None or not np.isfinite(value) else format(value, form)


def episodes_learned_from(config: RunConfig, models: WorldModels, count: int, work: Path) -> Imagined:
    """Simulator episodes in training scenes, from which a reward may be learned."""
    return imagined_episodes(config, models, "train", NEW_CONTEXTS.take(count), count, work)


def imagined_episodes(
    config: RunConfig, models: WorldModels, domain: str, first: int, count: int, work: Path
) -> Imagined:
    """Simulator episodes of config.task and BEHAVIOURS from seed `first` on, collected into `work` once, imagined."""
    chosen = config.with_values(
        simulation=config.simulation.with_values(scenes=domain),
        data=config.data.with_values(behaviours=BEHAVIOURS),
    )
    bags = collect_plan(task_plan(chosen, count, first), chosen, work.absolute() / f"{config.task}_{domain}_{first}")
    recorded = (episode for bag in bags for episode in read_episodes(bag))
    episodes = itertools.islice(recorded, count)  # an earlier call may have wanted more
    return imagine_all(models, stack_episodes(episodes, [config.task]), config.task)


def imagine_all(models: WorldModels, real: EpisodeArrays, task: str) -> Imagined:
    """Imagine the recorded actions, and keep what the done heads see."""
    column, seen, parts = models.task_index(task), list[Tensor](), list[ImaginedEpisodes]()

    def keep(module: nn.Module, inputs: tuple[Tensor, Tensor], _: object) -> None:
        tokens, register = inputs[:2]
        seen.append(pooled_features(tokens, register).float()[:, 0])

    features = list[FloatArray]()
    hook = models.action.done.register_forward_hook(keep)
    try:
        for i in range(0, len(real), BATCH):
            rows = slice(i, i + BATCH)
            seen.clear()
            parts.append(imagine(models.tokenizer, models.action, real.images[rows, 0], real.actions[rows],
                                 real.states[rows]))
            features.append(torch.stack(seen, 1).cpu().numpy())
    finally:
        hook.remove()
    frames, signals, spreads = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("frames", "signals", "uncertainty")
    )
    frames = np.concatenate([real.images[:, :1], frames], 1)
    return Imagined(real, frames, signals[..., column], spreads[..., column], np.concatenate(features))


def goals_of(models: WorldModels, real: EpisodeArrays, config: RunConfig) -> ImaginedGoals | None:
    """The golden trajectory of every episode, of its first frame and instruction; None without a text model."""
    if models.text is None:
        return None
    tasks = [models.task_index(config.task)] * len(real)
    return imagine_goals(
        models.text, models.tokenizer, real.images[:, 0], real.instructions, tasks, horizon=real.num_steps,
        threshold=config.reward.goal_threshold,
    )


def paid(
    found: Imagined, goals: ImaginedGoals | None, model_dir: Path, config: RunConfig
) -> dict[str, NDArray[np.float64]]:
    """By reward, its sum (E, T) up to each step, as RL is paid: nothing after the done signal."""
    distance = EncoderDistance(make_encoder(model_dir, config.device), identity="reward_test")
    asked: dict[str, dict[str, Any]] = {"done signal": {"dense_weight": 0.0, "sparse_weight": 1.0}}
    if goals is not None:
        asked |= {
            "goal distance": {"dense_weight": 1.0, "sparse_weight": 0.0, "mode": "delta"},
            "golden progress": {"dense_weight": 1.0, "sparse_weight": 0.0, "mode": "progress"},
            "goal distance and done signal": {"dense_weight": 1.0, "sparse_weight": 1.0, "mode": "delta"},
        }
    crossed = found.signals > config.reward.success_threshold
    valid = found.real.step_mask & (np.cumsum(crossed, 1) - crossed == 0)
    sums = dict[str, NDArray[np.float64]]()
    for name, settings in asked.items():
        reward = EndogenousReward(config.reward.with_values(**settings), distance)
        totals = np.zeros(valid.shape)
        for i, t in itertools.product(range(0, len(valid), TOGETHER), range(valid.shape[1])):
            rows = slice(i, i + TOGETHER)
            known: dict[str, Any] = {} if goals is None else {
                "goals": goals.goals[rows], "golden": goals.frames[rows], "golden_lengths": goals.lengths[rows],
            }
            step = RewardInput(
                found.frames[rows, t], found.frames[rows, t + 1], found.signals[rows, t], valid[rows, t],
                found.uncertainty[rows, t], **known,
            )
            totals[rows, t] = np.nan_to_num(reward.evaluate(step).total)
        sums[name] = np.cumsum(totals, 1)
    return sums


def judged(found: Imagined, config: RunConfig) -> NDArray[np.float64]:
    """What the reward agent pays, at the last step of an episode (E, T); else as paid_episodes."""
    lengths = found.real.lengths
    episodes = [
        (found.frames[row, : steps + 1], found.real.actions[row, :steps], found.real.instructions[row])
        for row, steps in enumerate(map(int, lengths))
    ]
    at_end = np.arange(found.real.num_steps) >= lengths[:, None] - 1
    return np.where(at_end, paid_episodes(episodes, config)[:, None], 0.0)


def paid_episodes(
    episodes: Sequence[tuple[UInt8Array, FloatArray, str]], config: RunConfig
) -> NDArray[np.float64]:
    """The reward agent's reward of whole episodes (E,). By default the embedded judge, which learned from recordings in
    which nothing is wrong.

    Args:
        episodes: pictures (T + 1, H, W, 3), actions (T, A) and instruction of each.

    Raises:
        ValueError: it gives no verdict on more than MAX_INVALID_SHARE of them; on fewer, they are NaN.
    """
    settings, jobs = episode_judge(config), list[ClipJob]()
    for number, (frames, actions, instruction) in enumerate(episodes):
        task = TaskSpec(instruction, config.task, settings.robot, frames[0], None, actions)
        jobs.append(ClipJob(clip_ref(f"episode {number}", frames, config.simulation.control_hz), task))
    with closing(JudgeService(settings, seed=config.seed, device=config.device)) as judge:
        verdicts = judge.judge(jobs)
    silent = [verdict for verdict in verdicts if not verdict.valid]
    if len(silent) > MAX_INVALID_SHARE * len(verdicts):
        raise ValueError(f"the reward agent gives no verdict on {len(silent)} of {len(verdicts)} episodes: "
                         f"{silent[0].status} {silent[0].reason}; mend the judge, see --judge.*")
    return np.array([verdict.reward if verdict.valid else np.nan for verdict in verdicts])


def learned_heads(seen: Imagined, model_dir: Path, seed: int) -> dict[str, Callable[[Imagined], NDArray[np.float64]]]:
    """Rewards learned from success in training scenes; each gives the largest value up to every step (E, T)."""
    weights, network = embedding_weights(seen), proxy_network(seen, model_dir, seed)
    return {
        "embedding head": lambda found: embedding_values(weights, found),
        "proxy network": lambda found: proxy_values(network, model_dir, found),
    }


def embedding_values(weights: NDArray[np.float64], found: Imagined) -> NDArray[np.float64]:
    return largest(found.features.astype(np.float64) @ weights[:-1] + weights[-1], found)


def proxy_values(network: nn.Module, model_dir: Path, found: Imagined) -> NDArray[np.float64]:
    with torch.no_grad():
        values = network(torch.from_numpy(_encoded(make_encoder(model_dir), found.frames[:, 1:])))[..., 0].sigmoid()
    return largest(values.numpy().astype(np.float64), found)


def embedding_weights(seen: Imagined) -> NDArray[np.float64]:
    """Weights and bias (F + 1,) of success, linear in the world model's features, by least squares (iVideoGPT)."""
    mask, success = seen.real.step_mask, seen.real.success[:, 1:, 0]
    inputs = np.concatenate([seen.features, np.ones_like(seen.features[..., :1])], -1)[mask].astype(np.float64)
    found: NDArray[np.float64] = np.linalg.solve(
        inputs.T @ inputs + RIDGE * np.eye(inputs.shape[1]), inputs.T @ success[mask].astype(np.float64)
    )
    return found


def proxy_network(seen: Imagined, model_dir: Path, seed: int) -> nn.Module:
    """The logit of success (..., 1), an MLP on the tokenizer's latents of a frame (DiWA)."""
    mask, success = seen.real.step_mask, seen.real.success[:, 1:, 0]
    features = _encoded(make_encoder(model_dir), seen.real.images[:, 1:])[mask]
    return _train_proxy(features, success[mask].astype(np.float64), seed)


def largest(values: NDArray[np.float64], found: Imagined) -> NDArray[np.float64]:
    """Of values (E, T), the largest so far; what follows the end of an episode does not count."""
    result: NDArray[np.float64] = np.maximum.accumulate(np.where(found.real.step_mask, values, -np.inf), 1)
    return result


def judge_reward(values: NDArray[np.float64], found: Imagined, seed: int) -> dict[str, Any]:
    """What a reward, given by its sum up to each step (E, T), says of real success: see measure_rewards. Episodes whose
    sum is NaN are left out."""
    said = np.isfinite(values[:, -1])
    won, values, success = found.won[said], values[said], found.real.success[said]
    empty, scores = np.array(found.real.behaviours)[said] == EMPTY_HAND, values[:, -1]
    empty &= ~won
    draws = numpy_stream(seed, "reward_test", len(won)).integers(len(won), size=(DRAWS, len(won)))
    drawn = np.array([auroc(won[rows], scores[rows]) for rows in draws])
    rows = np.flatnonzero(won)
    first = success[rows, 1:, 0].argmax(1) + 1
    along = [spearman(np.arange(steps), values[row, :steps], seed=seed, draws=1)[0]
             for row, steps in zip(rows, first, strict=True) if steps > 2]
    return {
        "episodes_scored": len(won), "successes": int(won.sum()),
        "auroc": [auroc(won, scores), *np.nanquantile(drawn, (0.025, 0.975)).tolist()],
        "auroc_empty_hand": auroc(won[won | empty], scores[won | empty]),
        "rank_correlation": float(np.nanmean(along)) if np.isfinite(along).any() else float("nan"),
    }


def _encoded(encode: Callable[[Tensor], Tensor], images: UInt8Array) -> FloatArray:
    """Features (E, T, F) of frames (E, T, H, W, 3)."""
    flat = images.reshape(-1, *images.shape[2:])
    with torch.inference_mode():
        parts = [encode(torch.from_numpy(flat[i : i + 256])).float().numpy() for i in range(0, len(flat), 256)]
    features: FloatArray = np.concatenate(parts).reshape(*images.shape[:2], -1)
    return features


def _train_proxy(features: FloatArray, targets: NDArray[np.float64], seed: int) -> nn.Module:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = nn.Sequential(
            nn.Linear(features.shape[-1], PROXY_WIDTH), nn.SiLU(), nn.Linear(PROXY_WIDTH, PROXY_WIDTH), nn.SiLU(),
            nn.Linear(PROXY_WIDTH, 1),
        )
    inputs, wanted = torch.from_numpy(features), torch.from_numpy(targets).float()
    optimizer, stream = torch.optim.AdamW(network.parameters(), lr=1e-3), torch_stream(seed, "proxy")
    for _ in range(PROXY_ITERATIONS):
        rows = torch.randint(len(inputs), (PROXY_BATCH,), generator=stream)
        loss = nn.functional.binary_cross_entropy_with_logits(network(inputs[rows])[:, 0], wanted[rows])
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    return network.eval()
