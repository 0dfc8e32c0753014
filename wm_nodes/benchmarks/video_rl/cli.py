"""DynDiff-GRPO against its rivals on the moving disc: diversity, learning, cost of the KL, ablations, and a reward that
can be hacked; diversity and learning on clips of recorded episodes, and their picture's size.

Every --json file holds the command, the settings of each sampler, and the sha256 of the weights that were measured; a
picture is drawn beside it (of ablations from two seeds on).
"""

import argparse
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from benchmarks.speed.results import write_results
from benchmarks.video_rl import closed_loop, diversity, outcome, plots, samplers, tables
from benchmarks.video_rl.clip_resolution import sample_clips, size_rows
from benchmarks.video_rl.comparison import CLIP_MEASURES
from benchmarks.video_rl.cost import measure_anchors, pushcube_buffer, pushcube_rollout, toy_buffer, toy_rollout
from benchmarks.video_rl.learning import train_on_discs, train_sampler
from benchmarks.video_rl.samplers import DiscPlan, LearningPlan, SamplerSetup, diversity_samplers, learning_samplers
from benchmarks.video_rl.sources import TASK, RecordedSource
from benchmarks.video_rl.trainings import against_cps, compare, draw, select, settings_of, train_all
from benchmarks.video_rl.trials import SamplerTrial, ablation_trials, hacking_trials
from wm_nodes.apps.options import add_device, add_json, add_seed, positive, prepare_torch
from wm_nodes.config.load import load_config, load_video_config
from wm_nodes.config.seed_ranges import HELDOUT, NEW_CONTEXTS, SeedRange
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.device import CPU, compute_device
from wm_nodes.core.files import file_sha256, write_atomic
from wm_nodes.core.progress import tqdm
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.environments.record import collect_plan, scripted_plan
from wm_nodes.training.weights import pack_weights
from wm_nodes.video_model import VideoNetwork
from wm_nodes.video_model.clips import load_clips
from wm_nodes.video_model.flow_matching import train_video_model
from wm_nodes.video_model.folder import VideoFolder, load_video_folder
from wm_nodes.video_rl.reference_reward import load_probe
from wm_nodes.video_rl.sampling import RecordedContexts
from wm_nodes.video_rl.toy_scene import BASE, NETWORK, load_base, training_batch
from wm_nodes.world_model.position_probe import PositionProbe

BASE_ITERATIONS, BASE_BATCH = 4000, 16
EPISODES = Path("runs/clip_contexts")
LEARNER = load_video_config("base").grpo.with_values(learning_rate=1e-4, micro_batch=64)
"""Table 5's clip, advantage clip, KL and step fraction; a learning rate for 76 k parameters instead of billions."""
LOG_COLUMNS = 180  # of tables that go to a file or a pipe
console = Console()


def add_options(parser: argparse.ArgumentParser) -> None:
    experiments = parser.add_subparsers(dest="experiment", required=True, metavar="EXPERIMENT")
    base = experiments.add_parser("base", help="train the base model (minutes on one core)")
    base.add_argument("--iterations", type=positive, default=BASE_ITERATIONS)
    base.add_argument("--out", type=Path, default=Path("runs/moving_disc"))
    spread = experiments.add_parser("diversity", help="diversity at equal quality and noise budget")
    learning = experiments.add_parser("learning", help="reward against model calls, every sampler on one learner")
    ablations = experiments.add_parser("ablations", help="KL, advantage clip, guidance, resolution, in pairs")
    hacking = experiments.add_parser("hacking", help="a reward that can be hacked, and what detects it")
    for experiment, iterations in ((learning, 40), (ablations, 12), (hacking, 25)):
        experiment.add_argument("--iterations", type=positive, default=iterations)
        experiment.add_argument("--scenes", type=positive, default=6, help="contexts per iteration, 8 videos each")
        experiment.add_argument("--eval-scenes", type=positive, default=100, help="held-out scenes per evaluation")
    cost = experiments.add_parser("cost", help="seconds and bytes of the KL anchors, and of the mask")
    cost.add_argument("--repeats", type=positive, default=7)
    clips = experiments.add_parser("clips", help="diversity on a video model of recorded episodes")
    outcome.add_options(experiments.add_parser("outcome", help="a video model that chooses the motion, by its outcome"))
    training = experiments.add_parser("clip-learning", help="learning on a video model of recorded episodes")
    training.add_argument("--iterations", type=positive, default=LearningPlan.iterations)
    training.add_argument("--eval-contexts", type=positive, default=LearningPlan.eval_contexts)
    training.add_argument("--heldout-bags", type=Path, nargs="+", default=[], metavar="BAG", help="and held-out ones")
    for experiment in (clips, training):
        experiment.add_argument(
            "--context-bags", type=Path, nargs="+", default=[], metavar="BAG",
            help=f"episodes to take contexts from (default: new ones in {EPISODES}, of seeds that no model has seen)",
        )
    resolution = experiments.add_parser("resolution", help="a video model on larger pictures than it was trained on")
    resolution.add_argument("--sizes", type=positive, nargs="+", default=[80, 96, 128], help="sides of a picture, px")
    resolution.add_argument(
        "--context-bags", type=Path, nargs="+", default=[], metavar="BAG",
        help="the same episodes in several sizes, a bag of each, the model's own size first (default: new ones)",
    )
    for experiment in (clips, training, resolution):
        experiment.add_argument("--video-model", type=Path, default=shipped_model(TASK) / "video_model")
    for experiment, contexts in ((spread, 100), (clips, 100), (training, 400), (resolution, 100)):
        experiment.add_argument("--contexts", type=positive, default=contexts, help="scenes or recorded episodes")
    for experiment in (spread, clips):
        experiment.add_argument("--group-size", type=positive, default=8)
    for experiment in (clips, resolution):
        experiment.add_argument("--preset", default="recommended", help="of loop 2: rewards, sampler steps, task")
    clips.add_argument(
        "--features", default="tokenizer",
        help="tokenizer, pixels, random, or the folder of a vision backbone, e.g. DINOv3 (default: tokenizer)",
    )
    for experiment in (learning, ablations, hacking, training):
        experiment.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    for experiment in (base, spread, cost, clips, resolution):
        add_seed(experiment)
    for experiment in (spread, learning, ablations, hacking, clips, training):
        experiment.add_argument("--samplers", "--arms", nargs="+", metavar="NAME")
    for experiment in (spread, learning, ablations, hacking, cost):
        experiment.add_argument("--base", type=Path, help="weights of another base model than the shipped experiment")
    for name, experiment in experiments.choices.items():
        if name != "outcome":
            add_device(experiment)
    for experiment in (spread, learning, ablations, hacking, cost, clips, training, resolution):
        add_json(experiment, "write every row here; trainings go on where the file stops")
    closed_loop.add_options(experiments.add_parser("closed-loop", help="going on from own frames, with controls"))


def run(arguments: argparse.Namespace) -> None:
    """One experiment; finished rows of --json are kept, so that it goes on where it was interrupted."""
    if not console.is_terminal:
        console.width = LOG_COLUMNS
    prepare_torch()
    arguments.device = compute_device(arguments.device or CPU)
    experiments = {
        "base": _base, "diversity": _diversity, "learning": _learning, "ablations": _ablations, "hacking": _hacking,
        "cost": _cost, "clips": _clips, "clip-learning": _clip_learning, "resolution": _resolution,
        "outcome": outcome.run, "closed-loop": closed_loop.run,
    }
    experiments[arguments.experiment](arguments)


def _base(arguments: argparse.Namespace) -> None:
    torch.manual_seed(arguments.seed)
    model = VideoNetwork(NETWORK).to(arguments.device)
    train_video_model(
        model, lambda iteration: training_batch(BASE_BATCH, arguments.seed, iteration),
        load_video_config("base").model.training.with_values(num_iterations=arguments.iterations),
        seed=arguments.seed, run_dir=arguments.out,
    )
    command = f"wm benchmark video-rl base --seed {arguments.seed} --iterations {arguments.iterations}"
    path = arguments.out / "video_model.safetensors"
    write_atomic(path, pack_weights(model, {"command": command}).data)
    console.print(f"written {path}", highlight=False)


def _diversity(arguments: argparse.Namespace) -> None:
    model = load_base(arguments.base, arguments.device)
    plan = {"contexts": arguments.contexts, "group_size": arguments.group_size}
    chosen = _choose_samplers(arguments)
    rows = [
        diversity.measure_discs(model, setup, **plan, seed=arguments.seed)
        for setup in tqdm(_with_both_noises(chosen), desc="diversity", unit="sampler")
    ]
    of = {"plan": plan, "seed": arguments.seed, "features": diversity.FEATURES, **settings_of(chosen)}
    comparisons = diversity.disc_comparisons(rows, arguments.seed)
    write_results(arguments, {**of, **_base_of(arguments), "rows": rows, "comparisons": comparisons})
    draw(arguments, plots.plot_diversity, rows, arguments.seed)
    console.print(tables.diversity_table(rows, arguments.seed))


def _with_both_noises(setups: list[SamplerSetup]) -> list[SamplerSetup]:
    """Each sampler with initial noise of every video's own, then each with one that a group shares."""
    return [replace(setup, shared_noise=shared) for shared in (False, True) for setup in setups]


def _clips(arguments: argparse.Namespace) -> None:
    config = load_video_config(arguments.preset, {"seed": arguments.seed})
    folder, probe = _models(arguments, config.task)
    bags = arguments.context_bags or _episodes(arguments.contexts, HELDOUT, config.task)
    clips = load_clips(bags, folder.clip["stride"])
    drawn = numpy_stream(arguments.seed, "clip_diversity").permutation(len(clips))[: arguments.contexts]
    contexts = clips.select(torch.from_numpy(drawn))
    features = diversity.load_features(arguments.features, config.task, arguments.device)
    chosen, rows = _choose_samplers(arguments), list[dict[str, Any]]()
    source = RecordedContexts(folder, contexts, config, probe)
    with tqdm(total=2 * len(chosen) * len(contexts), desc="clips", unit="context") as bar:
        for setup in _with_both_noises(chosen):
            bar.set_postfix_str(setup.name)
            rows.append(diversity.measure_clips(source, setup, features, arguments.group_size, bar.update))
    compared = diversity.clip_comparisons(rows, arguments.seed)
    size = {"contexts": len(contexts), "group_size": arguments.group_size, "features": features.name}
    of = {"rewards": config.rewards, "sha256": folder.manifest["sha256"], **settings_of(chosen)}
    write_results(arguments, {**size, "seed": arguments.seed, **of, "rows": rows, "comparisons": compared})
    draw(arguments, plots.plot_diversity, rows, arguments.seed)
    console.print(tables.clip_table(rows, arguments.seed), tables.clip_comparison_table(compared))


def _models(arguments: argparse.Namespace, task: str) -> tuple[VideoFolder, PositionProbe]:
    """The video model, and the probe of the task's shipped world model."""
    folder = load_video_folder(arguments.video_model, arguments.device)
    return folder, load_probe(shipped_model(task), arguments.device)


def _resolution(arguments: argparse.Namespace) -> None:
    config = load_video_config(arguments.preset, {"seed": arguments.seed})
    folder, probe = _models(arguments, config.task)
    sizes = [{"simulation.image_size": side} for side in (probe.height, *arguments.sizes)]
    recordings = [[bag] for bag in arguments.context_bags] or [
        _episodes(arguments.contexts, HELDOUT, config.task, size) for size in sizes
    ]
    rows, own = list[dict[str, Any]](), None
    for bags in tqdm(recordings, desc="resolution", unit="size"):
        clips = load_clips(bags, folder.clip["stride"])
        clips = clips.select(torch.arange(min(arguments.contexts, len(clips))))
        if own is None:
            own = sample_clips(folder, clips, config)
        rows += size_rows(folder, clips, own, config, probe)
    write_results(arguments, {"seed": arguments.seed, "sha256": folder.manifest["sha256"], "rows": rows})
    console.print(tables.resolution_table(rows))


def _episodes(clips: int, seeds: SeedRange, task: str, settings: Mapping[str, Any] | None = None) -> list[Path]:
    """Bags of scripted episodes, a tenth more than the clips that are wanted: one that ends early gives none."""
    scene = load_config("cpu", {"task": task, **(settings or {})})
    plan = scripted_plan(scene, math.ceil(1.1 * clips), seeds)
    of = "".join(f"_{value}" for value in (settings or {}).values())
    return collect_plan(plan, scene, EPISODES / f"{task}_{plan.first_seed}_{plan.num_episodes}{of}")


def _clip_learning(arguments: argparse.Namespace) -> None:
    base, probe = _models(arguments, TASK)
    bags = arguments.context_bags or _episodes(arguments.contexts, NEW_CONTEXTS, TASK)
    heldout_bags = arguments.heldout_bags or _episodes(arguments.eval_contexts, HELDOUT, TASK)
    contexts, heldout = (load_clips(recorded, base.clip["stride"]) for recorded in (bags, heldout_bags))
    plan = LearningPlan(arguments.iterations, eval_contexts=arguments.eval_contexts)
    of = {"sha256": base.manifest["sha256"]}
    trials = [SamplerTrial(sampler, plan) for sampler in samplers.clip_learning_samplers()]

    def train(trial: SamplerTrial[LearningPlan], seed: int, on_iteration: Callable[[], object]) -> dict[str, Any]:
        folder = load_video_folder(arguments.video_model, arguments.device)
        source = RecordedSource(folder, contexts, heldout, probe, trial.sampler, trial.plan, seed)
        return train_sampler(source, trial.sampler, trial.plan, seed, on_iteration)

    rows = train_all(arguments, trials, train, of)
    comparisons = compare(arguments, trials, rows, against_cps(rows), of, CLIP_MEASURES)
    draw(arguments, plots.plot_comparisons, comparisons)
    console.print(tables.clip_training_table(rows), tables.comparison_table(comparisons))


def _learning(arguments: argparse.Namespace) -> None:
    plan = _plan(arguments, eval_every=5)
    trials = [SamplerTrial(sampler, plan) for sampler in learning_samplers(LEARNER)]
    rows = _train_discs(arguments, trials)
    comparisons = compare(arguments, trials, rows, against_cps(rows), _base_of(arguments))
    draw(arguments, plots.plot_learning, rows)
    console.print(tables.training_table(rows), tables.gain_table(rows), tables.comparison_table(comparisons))


def _ablations(arguments: argparse.Namespace) -> None:
    trials, pairs = ablation_trials(LEARNER, _plan(arguments, eval_every=4))
    rows = _train_discs(arguments, trials)
    comparisons = compare(arguments, trials, rows, pairs, _base_of(arguments))
    draw(arguments, plots.plot_comparisons, comparisons)
    console.print(tables.training_table(rows), tables.comparison_table(comparisons))


def _hacking(arguments: argparse.Namespace) -> None:
    rows = _train_discs(arguments, hacking_trials(LEARNER, _plan(arguments, eval_every=3)))
    draw(arguments, plots.plot_hacking, rows)
    console.print(tables.hacking_table(rows))


def _plan(arguments: argparse.Namespace, eval_every: int) -> DiscPlan:
    return DiscPlan(arguments.iterations, arguments.scenes, eval_contexts=arguments.eval_scenes, eval_every=eval_every)


def _train_discs(arguments: argparse.Namespace, trials: list[SamplerTrial[DiscPlan]]) -> list[dict[str, Any]]:
    def train(trial: SamplerTrial[DiscPlan], seed: int, on_iteration: Callable[[], object]) -> dict[str, Any]:
        base = load_base(arguments.base, arguments.device)
        return train_on_discs(base, trial.sampler, trial.plan, seed, on_iteration)

    return train_all(arguments, trials, train, _base_of(arguments))


def _base_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Which base model was measured."""
    return {"sha256": {"base": file_sha256(arguments.base or BASE)}}


def _cost(arguments: argparse.Namespace) -> None:
    model = load_base(arguments.base, arguments.device)
    repeats, seed = arguments.repeats, arguments.seed
    rollouts = [toy_rollout(model, repeats, seed), pushcube_rollout(repeats, seed, arguments.device)]
    rows = [
        *measure_anchors("moving disc", model, toy_buffer(model, seed), LEARNER, repeats),
        *measure_anchors("PushCube", *pushcube_buffer(seed, arguments.device), LEARNER, repeats),
    ]
    of = {"seed": seed, "learner": LEARNER.model_dump(), **_base_of(arguments)}
    write_results(arguments, {**of, "rollouts": rollouts, "rows": rows})
    draw(arguments, plots.plot_cost, rows)
    console.print(tables.rollout_table(rollouts, repeats), tables.cost_table(rows, repeats))


def _choose_samplers(arguments: argparse.Namespace) -> list[SamplerSetup]:
    """The samplers of the diversity experiments that --samplers names."""
    return select({sampler.name: sampler for sampler in diversity_samplers()}, arguments.samplers)
