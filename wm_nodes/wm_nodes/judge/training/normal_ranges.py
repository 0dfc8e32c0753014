"""Measure the bands of endogenous evidence from faultless recordings, and write them as a rubric pack (RA-13, RA-17).

A signal outside its band contradicts a component that passes: the agent then votes on it and reflects. Bands hold for
one world model, one camera and one number of actions between two frames, so they are a pack that extends another one.
Every recording is measured as it is and as decoded by the model's tokenizer, because the loops judge decoded clips.

    python -m wm_nodes.judge.training.normal_ranges MODEL_DIR BAG [BAG ...] --check BAG [BAG ...] --output bands.yaml
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import yaml
from tqdm import tqdm

from wm_nodes.config.load import named_pack
from wm_nodes.core.files import write_atomic
from wm_nodes.core.types import Episode
from wm_nodes.judge.agent import TaskSpec, load_rubric
from wm_nodes.judge.agent.reflection import conflicting_evidence
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.evidence.pictures import pictures_of
from wm_nodes.judge.evidence.pixels import pixel_evidence
from wm_nodes.judge.evidence.world_model import model_evidence
from wm_nodes.recording import read_episodes
from wm_nodes.world_model import WorldModels, load_model_folder

LEAST = 50
"""Clips needed to estimate the edge of a band."""


@dataclass(frozen=True)
class Signal:
    """The component that a signal contradicts beyond one side of its band.

    of: the clips that the band is measured on; "done": those whose task is done at the end.
    """

    component: str
    side: Literal["low", "high"]
    of: Literal["all", "done"] = "all"


SIGNALS: Mapping[str, Signal] = {
    "sharpness_min": Signal("clarity", "low"),
    "tokenizer_error": Signal("clarity", "high"),
    "tokenizer_error_worst": Signal("clarity", "high"),
    "gain_min": Signal("brightness", "low"),
    "gain_max": Signal("brightness", "high"),
    "hue_max": Signal("color", "high"),
    "flicker_max": Signal("temporal", "high"),
    "still_energy": Signal("temporal", "low"),
    "surprise_over_still": Signal("temporal", "high"),
    "static_away": Signal("background", "high"),
    "surprise_max": Signal("interaction", "high"),
    "action_gain": Signal("interaction", "low"),
    "tool_error": Signal("interaction", "high"),
    "done_max": Signal("task_completion", "low", "done"),
}
"""surprise itself has no band: it is about as low in a frozen clip as it can be, which still_energy says."""

Row = Mapping[str, float]


def clip_rows(models: WorldModels, episodes: Iterator[Episode], stride: int) -> Iterator[tuple[Row, bool]]:
    """Evidence of each episode as a clip of every stride-th frame, recorded and decoded, and whether its task is done
    at its last one. Episodes too short for two frames are left out.
    """
    for episode in episodes:
        count = episode.num_steps // stride
        if not count:
            continue
        frames = episode.images[: count * stride + 1 : stride]
        actions = episode.actions[: count * stride].reshape(count, -1)
        task = TaskSpec(episode.instruction, episode.task, "", frames[0], actions=actions)
        for shown in (frames, models.tokenizer.decode(models.tokenizer.encode(frames)).numpy()):
            evidence = {**pixel_evidence(pictures_of(shown, frames[0])), **model_evidence(models, shown, task)}
            yield {name: evidence[name] for name in SIGNALS}, bool(episode.success[count * stride])


def bands_of(rows: Sequence[tuple[Row, bool]], tail: float) -> dict[str, dict[str, float | str]]:
    """A band per signal, with the share `tail` of its clips outside.

    Raises:
        ValueError: fewer than LEAST clips for a signal, or a tail that is no share.
    """
    if not 0 <= tail < 0.5:
        raise ValueError(f"tail must be a share below 0.5, got {tail}")
    bands: dict[str, dict[str, float | str]] = {}
    for name, signal in SIGNALS.items():
        values = [row[name] for row, done in rows if done or signal.of == "all"]
        if len(values) < LEAST:
            raise ValueError(
                f"{name} needs {LEAST} clips{' whose task is done' if signal.of == 'done' else ''}, the bags hold "
                f"{len(values)}; name more bags"
            )
        edge = float(np.quantile(values, tail if signal.side == "low" else 1 - tail))
        bands[name] = {"component": signal.component, signal.side: float(f"{edge:.4g}")}
    return bands


def count_outside(rows: Sequence[tuple[Row, bool]], rubric: Rubric) -> dict[str, int]:
    """Count the clips outside each band, among those that it applies to, and ("any") outside at least one."""
    counts = dict.fromkeys((*rubric.evidence, "any"), 0)
    for row, done in rows:
        meant = {name: value for name, value in row.items() if done or SIGNALS[name].of == "all"}
        conflicts = conflicting_evidence(rubric, meant)
        for name in [*conflicts, "any"] if conflicts else []:
            counts[name] += 1
    return counts


def _rows(models: WorldModels, bags: Sequence[Path], stride: int) -> list[tuple[Row, bool]]:
    episodes = (episode for bag in bags for episode in read_episodes(bag))
    return list(tqdm(clip_rows(models, episodes, stride), desc="measured", unit="clip"))


def main(argv: Sequence[str]) -> int:
    """Write the pack and print its bands. Return the exit code: 0 done, 2 a clear error."""
    parser = argparse.ArgumentParser(prog="evidence_bands", description=__doc__.splitlines()[0])
    parser.add_argument("model_dir", type=Path, help="world-model folder")
    parser.add_argument("bags", type=Path, nargs="+", help="recorded episodes in the model's cameras")
    parser.add_argument("--check", type=Path, nargs="+", default=[], help="further bags: how many leave the bands?")
    parser.add_argument("--output", type=Path, required=True, help="the pack, a .yaml file")
    parser.add_argument("--rubric", default="robot", help="pack that it extends")
    parser.add_argument("--stride", type=int, default=1, help="steps between two frames of a clip")
    parser.add_argument("--tail", type=float, default=0.005, help="share of the clips outside of each band")
    arguments = parser.parse_args(argv)
    try:
        if arguments.stride < 1 or arguments.output.suffix != ".yaml":
            raise ValueError(f"--stride must be >= 1 and --output a .yaml, got {arguments.stride}, {arguments.output}")
        base = load_rubric(arguments.rubric)
        models = load_model_folder(arguments.model_dir)
        rows = _rows(models, arguments.bags, arguments.stride)
        pack = {
            "extends": named_pack(arguments.rubric), "name": arguments.output.stem, "revision": base.revision,
            "evidence": bands_of(rows, arguments.tail),
        }
        head = f"# python -m wm_nodes.judge.training.normal_ranges {' '.join(argv)}\n# from {len(rows)} clips\n"
        write_atomic(arguments.output, (head + yaml.safe_dump(pack, sort_keys=False)).encode())
        rubric = load_rubric(str(arguments.output))
        checked = _rows(models, arguments.check, arguments.stride)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{arguments.output}: rubric {rubric.version}; {len(rows)} clips, {len(checked)} to check")
    counts = {"bands": count_outside(rows, rubric), "check": count_outside(checked, rubric)}
    print(f"{'evidence':22} {'component':16} {'low':>9} {'high':>9} {'outside':>8} {'check':>6}")
    for name, band in rubric.evidence.items():
        numbers = f"{band.low:9.4g} {band.high:9.4g} {counts['bands'][name]:8} {counts['check'][name]:6}"
        print(f"{name:22} {band.component:16} {numbers}")
    print(f"{'any of them':59} {counts['bands']['any']:8} {counts['check']['any']:6}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
