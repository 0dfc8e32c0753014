"""Build a set of clips with known labels from the simulator, to train and to compare judges on.

    wm build-judge-dataset FOLDER --tasks push_cube --episodes 8
    wm build-judge-dataset FOLDER --benchmark
    wm build-judge-dataset FOLDER --diverse --episodes 40 --edits 26 --seed 20000
    wm build-judge-dataset FOLDER --policy-view --development --episodes 40 --edits 26

--benchmark is the set that judges are compared on: three tasks, shapes that no judge was trained on, and seeds of its
own; its test split is fixed by the manifest and has 400 clips or more.
--development leaves out the episodes of the test part, which training does not read; --diverse does so too, and draws
cameras, colours, light and push directions from ranges that keep away from what is held out.
--policy-view draws the scene and the camera of the policy, most frames through a world model.
"""

import argparse
from collections import Counter
from pathlib import Path

from wm_nodes.apps.options import add_device, add_seed
from wm_nodes.config.load import default_task, load_config
from wm_nodes.config.tasks import task_names
from wm_nodes.core.device import CPU, compute_device
from wm_nodes.judge.dataset.build import BENCHMARK, SHAPES, SIDE_PX, SetPlan, build
from wm_nodes.judge.dataset.edits.recipes import RECIPES
from wm_nodes.judge.dataset.policy_camera import PolicyCamera, policy_models
from wm_nodes.judge.dataset.set_files import check_set
from wm_nodes.world_model import load_model_folder


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, help="new folder of the set")
    parser.add_argument("--tasks", nargs="+", choices=task_names(), default=[default_task()])
    parser.add_argument("--episodes", type=int, default=8, help="recorded episodes per task")
    parser.add_argument("--edits", type=int, help="edits tried on each; all by default")
    parser.add_argument(
        "--stacks", type=int, default=0, help="clips of up to three mild edits, every other one on a physical defect"
    )
    add_seed(parser)
    parser.add_argument("--shapes", nargs="+", choices=sorted(SHAPES), default=[], help="besides the cube, held out")
    parser.add_argument("--recipes", nargs="+", choices=sorted(RECIPES), default=tuple(RECIPES), help="all by default")
    parser.add_argument("--development", action="store_true", help="only episodes of the training and validation parts")
    parser.add_argument("--diverse", action="store_true", help="the same, with cameras, colours, light, ways at random")
    parser.add_argument(
        "--policy-view", nargs="?", type=Path, const=Path(), metavar="MODEL_DIR",
        help="scene and camera of the policy, most frames as a world model draws them; default: the shipped one",
    )
    parser.add_argument("--stride", type=int, default=1, help="of --policy-view: steps between two frames of a clip")
    add_device(parser, CPU)
    parser.add_argument("--benchmark", action="store_true", help="the set that judges are compared on; nothing else")
    parser.add_argument("--check", action="store_true", help="build nothing, verify the set that is there")


def run(arguments: argparse.Namespace) -> None:
    """Build or check a set and print its prevalence."""
    if arguments.check:
        manifest, skipped = check_set(arguments.folder), Counter[str]()
    else:
        plan = SetPlan(
            tuple(arguments.tasks), arguments.episodes, arguments.edits, arguments.seed,
            shapes=tuple(arguments.shapes), development=arguments.development or arguments.diverse,
            diverse=arguments.diverse, recipes=tuple(arguments.recipes), policy=arguments.policy_view is not None,
            stacks_per_clip=arguments.stacks,
        )
        if arguments.stride < 1 or (arguments.stride > 1 and not plan.policy):
            raise ValueError(f"--stride is of --policy-view and at least 1, got {arguments.stride}")
        plan = BENCHMARK if arguments.benchmark else plan
        camera = None
        if plan.policy:
            models = load_model_folder(policy_models(arguments.policy_view), compute_device(arguments.device))
            camera = PolicyCamera(models, SIDE_PX, arguments.stride)
        manifest, skipped = build(arguments.folder, plan, load_config("cpu").simulation, camera)
    splits = Counter(row.split for row in manifest.rows)
    parts = Counter(row.part for row in manifest.rows)
    print(f"{len(manifest.rows)} clips in {arguments.folder}: " + ", ".join(f"{n} {s}" for s, n in splits.items()))
    print(", ".join(f"{count} {part}" for part, count in sorted(parts.items())))
    print(f"{'label':16} {'pass':>6} {'fail':>6} {'unknown':>8}  fails")
    for name, counts in manifest.prevalence["all"].items():
        share = counts["fail"] / max(1, counts["pass"] + counts["fail"])
        print(f"{name:16} {counts['pass']:6} {counts['fail']:6} {counts['unknown']:8}  {share:5.1%}")
    for reason, count in skipped.most_common(10):
        print(f"left out {count} times: {reason}")
