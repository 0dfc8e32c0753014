"""Compare verdicts on imagined and on recorded clips with the success that the simulator measured (RA-17 to RA-20).

Held-out episodes are recorded in the simulator, and imagined by a world model from their first frames with the same
actions; the judge sees both kinds as an episode's clip, up to the step on which the real one succeeds. The label is the
simulator's: whether it did. Beside the judge stands the model's own done signal on the same imagined frames.

    wm benchmark judge imagined-vs-real FOLDER --task push_cube --json FILE
"""

import argparse
import asyncio
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.speed.results import write_results
from wm_nodes.apps.options import add_device, add_json
from wm_nodes.config.load import default_task, load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.seed_ranges import STARTS
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.tasks import get_task, task_names
from wm_nodes.core.allocator import keep_freed_memory
from wm_nodes.core.device import CPU, compute_device
from wm_nodes.core.progress import tqdm
from wm_nodes.core.types import BoolArray
from wm_nodes.environments.record import collect_plan, scripted_plan
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import GATED, Status, TaskSpec, clip_ref
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.backends.factory import make_judge
from wm_nodes.judge.decisions import OVERALL, accepts, decisions_of, match
from wm_nodes.judge.episode_reward import episode_judge
from wm_nodes.judge.service import ClipJob
from wm_nodes.policy_rl.pretraining import load_arrays
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.world_model import load_model_folder
from wm_nodes.world_model.validation.open_loop import ImaginedEpisodes, auc, imagine_episodes

FIRST_SEED = STARTS.first
"""Of the episodes; nothing was ever trained on these."""


@dataclass(frozen=True)
class ImaginedAgreement:
    """A judge against the simulator on n clips, of which `judged` got a reward. real: share of successes among them.
    accuracy, low, high: of accepting, with Wilson's 95 % interval; balanced: mean of both recalls; auroc: of the
    reward. closed: clips that each gate refused. reward_success, reward_failure: mean rewards."""

    kind: str
    n: int
    judged: int
    real: float
    accuracy: float
    low: float
    high: float
    balanced: float
    auroc: float
    closed: dict[str, int]
    reward_success: float
    reward_failure: float


def episode_ends(episodes: EpisodeArrays, task: str) -> tuple[NDArray[np.int64], BoolArray]:
    """(last frame, succeeded) of each episode, int64 and bool (E,): the first frame of success, else the last one."""
    won = episodes.success[:, 1:, episodes.tasks.index(task)] & episodes.step_mask
    succeeded = won.any(1)
    return np.where(succeeded, won.argmax(1) + 1, episodes.lengths), succeeded


def jobs(
    episodes: EpisodeArrays, imagined: ImaginedEpisodes, config: RunConfig, last: NDArray[np.int64]
) -> Iterator[tuple[str, ClipJob]]:
    """The recorded clip of each episode and then the imagined one, by kind."""
    for e, end in enumerate(map(int, last)):
        first = episodes.images[e, :1]
        for kind, after in (("recorded", episodes.images[e, 1:]), ("imagined", imagined.frames[e])):
            clip = clip_ref(f"{kind} {e}", np.concatenate([first, after[:end]]), config.simulation.control_hz)
            task = TaskSpec(
                get_task(config.task).instruction, config.task, config.judge.robot, first[0],
                actions=episodes.actions[e, :end],
            )  # both tasks are recorded in one scene, under the instruction of one
            yield kind, ClipJob(clip, task)


def agreement(kind: str, verdicts: Sequence[Verdict], succeeded: BoolArray) -> ImaginedAgreement:
    """Compare verdicts with what the simulator says of the same episodes. Raises ValueError: no clip got a reward."""
    both = zip(verdicts, succeeded, strict=True)
    judged = [(v, bool(real)) for v, real in both if v.valid and accepts(v) is not None]
    if not judged:
        raise ValueError(f"none of {len(verdicts)} {kind} clips got a reward; the first says: {verdicts[0].reason}")
    agreed = match(OVERALL, [real for _, real in judged], [decisions_of(v)[OVERALL] for v, _ in judged])
    rewards, real = np.array([v.reward for v, _ in judged]), np.array([real for _, real in judged])
    closed = {
        str(stage): sum(s.status is Status.OK and not s.passed for v, _ in judged for s in v.stages if s.stage is stage)
        for stage in GATED
    }
    means = [float(rewards[rows].mean()) if rows.any() else float("nan") for rows in (real, ~real)]
    return ImaginedAgreement(
        kind, len(verdicts), len(judged), float(real.mean()), agreed.accuracy, agreed.low, agreed.high, agreed.balanced,
        auc(rewards, real), closed, *means,
    )


async def _judge_clips(agent: RewardAgent, asked: Sequence[ClipJob]) -> list[Verdict]:
    return [await agent.evaluate(job.clip, job.task) for job in tqdm(asked, desc="judged", unit="clip")]


def _measure(arguments: argparse.Namespace) -> dict[str, Any]:
    given = {
        "task": arguments.task, "device": arguments.device, "judge.kind": "embedded",
        "judge.folder": str(arguments.judge or ""),
    }
    config = load_config("cpu", given)
    models = load_model_folder(arguments.model_dir or shipped_model(config.task), compute_device(config.device))
    bags = collect_plan(scripted_plan(config, arguments.episodes, STARTS), config, arguments.folder)
    episodes = load_arrays(bags, config)
    imagined = imagine_episodes(models.tokenizer, models.action, episodes)
    last, succeeded = episode_ends(episodes, config.task)
    rubric = load_rubric(config.judge.rubric)
    opened = make_judge(episode_judge(config), rubric, device=config.device)
    agent = RewardAgent(opened.judge, rubric, seed=config.seed)
    asked = list(jobs(episodes, imagined, config, last))
    verdicts = asyncio.run(_judge_clips(agent, [job for _, job in asked]))
    signal = imagined.signals[..., models.task_index(config.task)]
    strongest = np.array([signal[e, :end].max() for e, end in enumerate(last)])
    fired = strongest > config.reward.success_threshold
    kinds = [kind for kind, _ in asked]
    return {
        "task": config.task, "judge": opened.judge.capabilities.judge_id, "model": models.sha256,
        "episodes": len(episodes), "first_seed": FIRST_SEED, "succeeded": int(succeeded.sum()),
        "agreement": [
            asdict(agreement(kind, [v for v, k in zip(verdicts, kinds) if k == kind], succeeded))
            for kind in ("recorded", "imagined")
        ],
        "done_signal": {
            "accuracy": float((fired == succeeded).mean()), "auroc": auc(strongest, succeeded),
            "balanced": float(np.mean([(fired == succeeded)[succeeded == real].mean() for real in (True, False)])),
        },
        "silent": [v.reason for v in verdicts if not v.valid],
    }


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, help="of the recorded episodes; finished ones are taken up again")
    parser.add_argument("--task", choices=task_names(), default=default_task())
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--judge", type=Path, help="folder of a trained judge; default: the shipped one")
    parser.add_argument("--model-dir", type=Path, help="world model; default: the shipped one")
    add_device(parser, CPU)
    add_json(parser)


def run(arguments: argparse.Namespace) -> None:
    """Measure, write --json and print it without the single clips."""
    keep_freed_memory()
    results = _measure(arguments)
    write_results(arguments, results, exact=True)
    print(json.dumps({name: value for name, value in results.items() if name != "silent"}, indent=1))
