"""Post-train a flow-matching video world model by DynDiff-GRPO, as a ROS 2 graph, and measure it on held-out contexts
before and after.

Collected bags, the trained model, finished evaluations and the learner's checkpoint stay in the run folder, so a run
can be resumed by naming it. Its clips can be scored again (wm rescore RUN) and trained on again (wm retrain RUN).
"""

import argparse
import os
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from wm_nodes.apps import options
from wm_nodes.apps.policy_run import READY_S
from wm_nodes.apps.video_results import conclude
from wm_nodes.config.load import (
    REWARDS,
    VIDEO,
    load_config,
    load_video_config,
    reward_overrides,
    with_judge,
)
from wm_nodes.config.object_state import with_reader
from wm_nodes.config.schema import AGENT, EXECUTION, RunConfig
from wm_nodes.config.seed_ranges import HELDOUT, MODEL_EPISODES
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.device import compute_device
from wm_nodes.core.progress import tqdm
from wm_nodes.environments.record import collect_plan, scripted_plan
from wm_nodes.judge.backends.factory import check_clips, check_judge, for_task
from wm_nodes.judge.service import clip_fps
from wm_nodes.launching import arguments as launch_arguments
from wm_nodes.launching.graph_client import GraphClient
from wm_nodes.launching.runner import Runner
from wm_nodes.reports.stages import Stages
from wm_nodes.training.run_record import Starter
from wm_nodes.video_model.clips import load_clips
from wm_nodes.video_rl.execution_reward import check_execution
from wm_nodes.video_rl.pretraining import make_video_model, shipped_video_model
from wm_nodes.video_rl.recorded_buffers import recorded_bags
from wm_nodes.video_rl.reference_reward import check_scenery, load_probe
from wm_nodes.video_rl.training_run import progress

HELDOUT_EPISODES = 100
FIXED: dict[str, Any] = {"preset": "recommended", "from_scratch": False, "bags": [], "heldout_bags": []}
FREE = {"keep_buffers": 4, "tensorboard": True}
"""Options that a run keeps with their defaults, see training/run_record.py."""


def add_options(parser: argparse.ArgumentParser) -> None:
    options.add_preset(parser, "recommended", VIDEO)
    options.add_seed(parser, None)
    options.add_run_dir(parser)
    parser.add_argument(
        "--from-scratch", action="store_true",
        help="train a video model of your own even where one with these settings is shipped (half an hour on one core)",
    )
    parser.add_argument(
        "--bags", type=Path, nargs="+", default=[], metavar="BAG",
        help="recorded simulator episodes to train on and to draw contexts from in place of new ones, e.g. those of a "
        "run of online_rl.py: RUN/bags/heldout/shard_*",
    )
    parser.add_argument("--heldout-bags", type=Path, nargs="+", default=[], metavar="BAG", help="and those held out")
    parser.add_argument(
        "--keep-buffers", type=int, metavar="N",
        help="rollout buffers kept on disk; as many as iterations if `retrain` shall be possible. Default: 4",
    )
    parser.add_argument(
        "--reward", choices=REWARDS,
        help="agent: a judge's verdict on each clip; execution: whether the task gets done when the action world model "
        "follows the clip's motion (with --preset outcome); reference: how well the clip follows its recording; "
        "closeness: how alike both look, which needs no simulator state. Default: what the preset weighs",
    )
    options.add_judge(parser)
    options.add_tensorboard(parser)
    options.add_view(parser)
    options.add_graph(parser)
    parser.set_defaults(**dict.fromkeys(["preset", "from_scratch", *FREE]))


def run(arguments: argparse.Namespace) -> None:
    """Take or record episodes, take or train a video model, run GRPO over the graph, measure, report."""
    options.prepare_torch()
    options.take_port(arguments)
    with opened(arguments) as (config, run_dir):
        _run(arguments, config, run_dir)


def opened(arguments: argparse.Namespace) -> AbstractContextManager[tuple[VideoRlConfig, Path]]:
    """The run folder of the options, see options.open_run. Raises ValueError for options that do not go together."""
    _check_options(arguments)
    starter = Starter("train-video-model", _load, FIXED, FREE, options.OPTION_OF, prefix="--")
    settings = reward_overrides(arguments.reward) | options.settings(arguments) | options.judge_settings(arguments)
    return options.open_run(arguments, starter, settings, name=lambda config: "world_model_rl", check=_check)


def _run(arguments: argparse.Namespace, config: VideoRlConfig, run_dir: Path) -> None:
    stage = Stages()
    stage(f"run folder {run_dir}")
    shipped_world = shipped_model(config.task)
    scene = with_reader(load_config("cpu", {"task": config.task, "seed": config.seed}), shipped_world)
    probe = load_probe(shipped_world, compute_device(config.device))
    shipped = None if arguments.from_scratch else shipped_video_model(config)
    if arguments.bags:
        stage(f"{len(arguments.bags)} + {len(arguments.heldout_bags)} held-out recordings")
        bags = linked([*map(Path, arguments.bags)], run_dir / "data" / "train")
        heldout_bags = linked([*map(Path, arguments.heldout_bags)], run_dir / "data" / "heldout")
    else:
        bags, heldout_bags = _data(scene, config.context_episodes if shipped else config.data_episodes, run_dir, stage)
    heldout = load_clips(heldout_bags, config.model.stride, config.clip_steps, config.task)
    stage("video model: " + ("the shipped one" if shipped else "flow matching"))
    clips = load_clips(bags, config.model.stride, config.clip_steps, config.task)
    if config.rewards.get(EXECUTION):
        check_execution(config, clips)
    if config.rewards.get("scenery") and not config.groups.history:
        check_scenery(clips)
    if config.rewards.get(AGENT):
        judge, fps = for_task(config.judge, config.task), clip_fps(bags[0], config.model.stride)
        check_clips(judge, tuple(clips.frames.shape[1:]), fps)
    make_video_model(config, clips, heldout, probe, run_dir, shipped=shipped, command=arguments.command)
    version, done = progress(run_dir)
    if done < config.iterations:
        _post_train(arguments, config, (bags, heldout_bags), run_dir, stage)
        version, done = progress(run_dir)
    conclude(
        config, run_dir, base=run_dir / "video_model", iterations=done, version=version, heldout=heldout, probe=probe,
        preset=arguments.preset, bag=str(recorded_bags(run_dir)[-1]), command=arguments.command, minutes=stage.minutes,
    )


def linked(bags: Sequence[Path], folder: Path) -> list[Path]:
    """Links to recordings of the simulator, named like the shards of episodes that a run collects itself.

    Raises:
        ValueError: the folder links to another recording.
    """
    folder.mkdir(parents=True, exist_ok=True)
    links = [folder / f"shard_{index:08d}" for index in range(len(bags))]
    for link, bag in zip(links, bags, strict=True):
        if not link.is_symlink():
            link.symlink_to(bag.resolve(), target_is_directory=True)
        if link.resolve() != bag.resolve():
            raise ValueError(f"{link} is of {link.resolve()}, not {bag}; use a new run folder")
    return links


def _data(scene: RunConfig, episodes: int, run_dir: Path, stage: Stages) -> tuple[list[Path], list[Path]]:
    """Bags of contexts to train on, and of held-out ones."""
    stage(f"{episodes} + {min(HELDOUT_EPISODES, episodes)} held-out simulator episodes")
    train = scripted_plan(scene, episodes, MODEL_EPISODES)
    held = scripted_plan(scene, min(HELDOUT_EPISODES, episodes), HELDOUT)
    bags = collect_plan(train, scene, run_dir / "data" / "train")
    return bags, collect_plan(held, scene, run_dir / "data" / "heldout")


def _post_train(
    arguments: argparse.Namespace, config: VideoRlConfig, bags: tuple[list[Path], list[Path]], run_dir: Path,
    stage: Stages,
) -> None:
    """GRPO over the graph, from the learner's checkpoint on. bags: of contexts, and of held-out ones."""
    contexts, heldout = (",".join(map(str, some)) for some in bags)
    graph, _ = launch_arguments.prepare("world_model_rl", {
        "run_dir": str(run_dir),
        "bag_uri": str(run_dir / "bags" / f"world_model_rl_{time.strftime('%Y%m%d_%H%M%S')}"),
        "video_model_dir": str(run_dir / "video_model"), "context_bags": contexts, "heldout_bags": heldout,
        "keep_buffers": str(arguments.keep_buffers), "tensorboard": "true" if arguments.tensorboard else "false",
        "domain_id": arguments.domain_id, **arguments.view,
    })
    stage("starting the graph: " + ", ".join(node.label for node in graph.nodes))
    with Runner(graph, log_dir=run_dir / "logs", log=sys.stdout if arguments.verbose else None) as runner:
        runner.wait_ready(READY_S)
        os.environ.update(runner.environment)
        with (
            GraphClient(alive=runner.check) as operator,
            tqdm(total=config.iterations, desc="GRPO", unit="buffer") as bar,
        ):
            _, done = progress(run_dir)
            bar.update(done)

            def show(feedback: Any) -> None:
                bar.update(done + feedback.iteration - bar.n)
                bar.set_postfix(reward=f"{feedback.reward_mean:.3f}", kl=f"{feedback.kl:.1e}")

            operator.train_video(config.iterations - done, show)


def _check_options(arguments: argparse.Namespace) -> None:
    if arguments.keep_buffers is not None and arguments.keep_buffers < 1:
        raise ValueError(f"--keep-buffers must be at least 1, got {arguments.keep_buffers}")
    if arguments.reward and "rewards" in arguments.settings:
        raise ValueError("--reward and --rewards both say all that pays; give one of them, or --rewards.NAME beside it")
    if bool(arguments.bags) != bool(arguments.heldout_bags):
        raise ValueError("--bags and --heldout-bags go together: what is trained on, and what is held out")
    if missing := [bag for bag in (*arguments.bags, *arguments.heldout_bags) if not bag.is_dir()]:
        raise ValueError(f"{missing[0]} is no recording; name bags of simulator episodes, e.g. RUN/data/train/shard_*")
    if twice := {bag.resolve() for bag in arguments.bags} & {bag.resolve() for bag in arguments.heldout_bags}:
        raise ValueError(f"{min(twice)} cannot be trained on and held out; name other --heldout-bags")


def _load(file: str, settings: dict[str, Any], chosen: Mapping[str, Any]) -> VideoRlConfig:
    return with_judge(load_video_config(file, settings))


def _check(config: VideoRlConfig) -> None:
    compute_device(config.device)
    if config.rewards.get(AGENT):
        check_judge(config.judge)
    if config.grpo.kl.anchor == "lora_off":
        raise ValueError(
            "grpo.kl.anchor lora_off is for public models with a LoRA adapter, trained in Python "
            "(docs/public_video_models.md); the graph's video model has none: take frozen"
        )
