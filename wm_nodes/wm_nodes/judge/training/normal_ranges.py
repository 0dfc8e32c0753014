"""Measure the bands of endogenous evidence from faultless recordings, and write them as a rubric pack (RA-13, RA-17).

A signal outside its band contradicts a component that passes: the agent then votes on it and reflects. Bands hold for
one world model, one camera and one number of actions between two frames, so they are a pack that extends another one.
Every recording is measured as it is and as decoded by the model's tokenizer, because the loops judge decoded clips.
As a command: wm normal-ranges.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from wm_nodes.core.types import Episode
from wm_nodes.judge.agent.reflection import conflicting_evidence
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import TaskSpec
from wm_nodes.judge.evidence.pictures import pictures_of
from wm_nodes.judge.evidence.pixels import pixel_evidence
from wm_nodes.judge.evidence.world_model import model_evidence
from wm_nodes.world_model import WorldModels

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
        for shown in (frames, models.tokenizer.decode(models.tokenizer.encode(frames)).cpu().numpy()):
            evidence = {**pixel_evidence(pictures_of(shown, frames[0])), **model_evidence(models, shown, task)}
            yield {name: evidence[name] for name in SIGNALS}, bool(episode.success[count * stride])


def bands_of(rows: Sequence[tuple[Row, bool]], tail: float) -> dict[str, dict[str, float | str]]:
    """A band per signal, the share `tail` of its clips outside. Raises ValueError: too few clips, or no such share."""
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
        bands[name] = {"component": signal.component, signal.side: float(f"{edge:.6g}")}
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
