"""Prepare what a run needs besides a world model: frames to imagine from, the weak policy that RL starts from."""

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from safetensors.torch import save

from wm_nodes.config import seed_ranges
from wm_nodes.config.object_state import is_read, of_demonstrations
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.tasks import get_task, has_rule, has_simulator, success
from wm_nodes.core.files import write_atomic
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.types import RECOVERY, Episode
from wm_nodes.environments.collection import CollectionPlan
from wm_nodes.environments.object_reader import ObjectReader, load_object_reader
from wm_nodes.environments.record import (
    as_compared,
    collect_plan,
    demonstration_plan,
    first_frames_plan,
    recovery_plan,
    scripted_plan,
)
from wm_nodes.policy_rl.behaviour_cloning import EXPERT, demonstrations, train_sft
from wm_nodes.policy_rl.factories import STARTS, make_policy, make_reconstruct, policy_actor, run_spec
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.recording import BagReport, read_episodes
from wm_nodes.training.contents import content_of
from wm_nodes.training.weights import save_weights
from wm_nodes.world_model.folder import read_world_manifest
from wm_nodes.world_model.starts import INSTRUCTIONS, join_starts, pack_instructions

MADE_OF = "starts.json"
MAX_STARTS, MODEL_STARTS = 512, 64
"""Most first frames of a run, and of those beside a model, from which a launch file imagines by default; of a model of
several scenes, half as many of each task."""
NUM_STARTS = 256


def num_starts(config: RunConfig) -> int:
    """Return the number of first frames of a run; imagined success is measured on as many episodes."""
    return min(NUM_STARTS, 8 * config.evaluation.episodes)


def starts_plan(config: RunConfig) -> CollectionPlan:
    """Return the plan of the episodes that a run's starts are taken from: one step each, or whole scripted ones."""
    if config.data.start_frames == "first":
        return first_frames_plan(config, num_starts(config))
    return replace(scripted_plan(config, num_starts(config), seed_ranges.STARTS), task=config.task)


def write_starts(
    bags: Iterable[Path], path: Path, limit: int = MAX_STARTS, *, tasks: Sequence[str] = (),
    frames: Literal["first", "any"] = "first", seed: int = 0,
) -> int:
    """Write a frame, its state and the instruction of up to `limit` episodes of each task that bags were recorded for;
    returns how many. First frames have their reset seeds beside them.

    Args:
        tasks: those that are imagined from these starts, beside the one of the recording.
        frames: see data.start_frames; `any` is before success in all the tasks, drawn from the stream `start_frames` of
            the seed.
    """
    chosen, counts = list[Episode](), Counter[str]()
    for bag in bags:
        for episode in read_episodes(bag):
            if counts[episode.task] == limit:
                break
            if episode.success[0]:
                continue  # as of an imported try that a gap has cut: nothing is left to do
            counts[episode.task] += 1
            chosen.append(episode)
    write_atomic(path, save(episode_starts(chosen, tasks=tasks, frames=frames, seed=seed)))
    return len(chosen)


def episode_starts(
    chosen: Sequence[Episode], *, tasks: Sequence[str] = (), frames: Literal["first", "any"] = "first", seed: int = 0
) -> dict[str, torch.Tensor]:
    """What write_starts writes of these episodes, by name. Raises ValueError: there is none."""
    if not chosen:
        raise ValueError("there is no episode to start from whose first frame is not a success already; record the "
                         "robot before it has done the task, with success false")
    stream = numpy_stream(seed, "start_frames")
    rows = [int(stream.integers(frames_before_success(e, tasks))) if frames == "any" else 0 for e in chosen]
    return {
        "images": torch.from_numpy(np.stack([episode.images[row] for episode, row in zip(chosen, rows)])),
        "states": torch.from_numpy(np.stack([episode.states[row] for episode, row in zip(chosen, rows)])),
        INSTRUCTIONS: pack_instructions(chosen),
        **({"seeds": torch.tensor([e.seed for e in chosen], dtype=torch.int64)} if frames == "first" else {}),
    }


def write_round_starts(config: RunConfig, first_frames: Path, bags: Iterable[Path], path: Path) -> None:
    """Write a run's first frames and up to model_refresh.own_starts frames of a policy's episodes, before success.

    Args:
        first_frames: as write_starts wrote it. bags: of the policy's episodes.
    """
    tasks = () if get_task(config.task).parts else (config.task,)
    own, limit = path.with_name("own_starts.safetensors"), config.model_refresh.own_starts
    write_starts(bags, own, limit, tasks=tasks, frames="any", seed=config.seed)
    write_atomic(path, save(join_starts(first_frames, own)))


def frames_before_success(episode: Episode, tasks: Sequence[str] = ()) -> int:
    """Return how many frames an episode has before it succeeds in any of the tasks or its own; at least 1."""
    others = [success(task, episode.ground_truth) for task in tasks if task != episode.task and has_rule(task)]
    done = np.logical_or.reduce([episode.success, *others])
    return max(1, int(done.argmax())) if done.any() else len(done)


def train_weak_policy(
    config: RunConfig, model_dir: Path, demo_bags: Iterable[Path], path: Path, *, anyone: bool = False,
    recoveries: Iterable[Path] = (),
) -> ImagePolicy:
    """Behaviour-clone a few demonstrations on raw and on tokenizer-reconstructed frames; write the weights to `path`.

    Args:
        anyone: whoever acted in a successful episode has demonstrated, not the planner alone.
        recoveries: bags of sft.recoveries further demonstrations, see recovery_plan.

    Raises:
        ValueError: the bags hold fewer successful demonstrations than sft.num_demonstrations. BagError: they are of
            another robot or other cameras than the model.
    """
    policy, spec = make_policy(config, model_dir), run_spec(config, model_dir)
    report = BagReport() if anyone else None  # of what a live recording lost
    episodes = (e for bag in demo_bags for e in read_episodes(bag, expected=spec, report=report))
    if anyone:
        episodes = (replace(episode, behaviour=EXPERT) for episode in episodes)
    demos = demonstrations(episodes, config.sft.num_demonstrations)
    if more := [*recoveries]:
        recovered = (e for bag in more for e in read_episodes(bag, expected=spec))
        demos += demonstrations(recovered, config.sft.recoveries, RECOVERY, "sft.recoveries")
    twin = None
    if config.sft.state_noise_m and is_read(config):
        twin = partial(as_read, reader=load_object_reader(Path(config.simulation.object_state), spec))
    sees = policy.encoder.feature_dim > 0
    shown = make_reconstruct(model_dir, config.device) if sees else None
    lengths = [i for i in spec.measured if spec.state_units[i] == "m"]
    train_sft(policy, demos, config.sft, config.seed, reconstruct=shown, noisy=lengths, twin=twin)
    save_weights(policy, path, {"tokenizer_sha256": policy.encoder.sha256})
    return policy


def as_read(demo: Episode, reader: ObjectReader) -> Episode:
    """The demonstration as an environment shows it whose states the reader fills."""
    return replace(demo, states=reader.fill_clip(demo.images, demo.states))


def start_files(run_dir: Path) -> tuple[Path, Path]:
    """Return the paths of a run's starts and of its weak policy, as prepare_start writes them."""
    return run_dir / STARTS, run_dir / "policies" / "weak.safetensors"


def _keep_settings(config: RunConfig, run_dir: Path, model_dir: Path) -> None:
    """Write beside the starts what they and the weak policy follow from; refuse a folder of others."""
    made_of = config.model_dump(mode="json", include={
        "task": True, "seed": True, "sft": True, "policy": True,
        "data": {"start_frames", "behaviours"} if config.data.start_frames == "any" else {"start_frames"},
    })
    made_of["simulation"] = as_compared(config.simulation)
    made_of["sft"]["bags"] = [content_of(bag) or bag for bag in config.sft.bags]  # they may be moved
    now = {
        f"{section}.{name}": value for section, values in made_of.items() if isinstance(values, dict)
        for name, value in values.items()
    }
    now |= {"task": config.task, "seed": config.seed, "first frames": num_starts(config)}
    now["tokenizer"] = read_world_manifest(model_dir)["sha256"]["tokenizer"]
    path = run_dir / MADE_OF
    kept = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    for name, value in now.items():
        if kept.get(name, value) != value:
            raise ValueError(f"the policy and first frames in {run_dir} were made with {name} {kept[name]}, not "
                             f"{value}; take another folder")
    write_atomic(path, json.dumps(now, indent=1).encode())


def planned_demonstrations(config: RunConfig) -> int:
    """How many are planned, so that sft.num_demonstrations succeed."""
    return config.sft.num_demonstrations + max(3, config.sft.num_demonstrations // 3)


def prepare_start(config: RunConfig, run_dir: Path, model_dir: Path) -> tuple[Path, Path]:
    """Collect demonstrations and starts and train the weak policy, as far as missing; return start_files(). Where
    sft.bags names the demonstrations, or no task can be simulated, those and the model's starts are taken.

    Raises:
        ValueError: the folder holds those of other settings or of another tokenizer.
    """
    _keep_settings(config, run_dir, model_dir)
    recorded = of_demonstrations(config)
    demos = [Path(bag) for bag in config.sft.bags]
    if config.sft.recoveries and not has_simulator(config.task):
        raise ValueError(f"sft.recoveries {config.sft.recoveries} need a script, and nothing simulates the task; set 0")
    if not demos:
        plan = demonstration_plan(recorded, planned_demonstrations(config))
        demos = collect_plan(plan, recorded, run_dir / "bags" / "demos")
    starts, weak = start_files(run_dir)
    if not starts.exists() and not has_simulator(config.task):
        write_atomic(starts, (model_dir / STARTS).read_bytes())
    elif not starts.exists():
        bags = collect_plan(starts_plan(config), config, run_dir / "bags" / "starts")
        write_starts(bags, starts, frames=config.data.start_frames, seed=config.seed)
    if not weak.exists():
        anyone, recoveries = bool(config.sft.bags), list[Path]()
        if config.sft.recoveries:
            clone = weak.with_name("clone.safetensors")
            train_weak_policy(config, model_dir, demos, clone, anyone=anyone)
            plan = recovery_plan(
                recorded, partial(policy_actor, config, model_dir, clone), planned_demonstrations(config)
            )
            recoveries = collect_plan(plan, recorded, run_dir / "bags" / "recoveries")
        train_weak_policy(config, model_dir, demos, weak, anyone=anyone, recoveries=recoveries)
    return starts, weak
