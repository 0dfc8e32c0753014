"""Endogenous evidence of a clip, for the bands of a rubric (RA-13, RA-17).

Pixel evidence needs the frames only; evidence of a world model needs one that was trained in the clip's cameras, and
the clip's actions. Evidence makes the agent vote and reflect, and never adds reward.
"""

import functools
import math
import threading
from pathlib import Path

import numpy as np

from wm_nodes.core.device import CPU, compute_device
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import ClipRef, TaskSpec
from wm_nodes.judge.evidence.pictures import pictures_of
from wm_nodes.judge.evidence.pixels import pixel_evidence
from wm_nodes.judge.evidence.world_model import MODEL_EVIDENCE, model_evidence
from wm_nodes.world_model import WorldModels, load_model_folder


class ClipEvidence:
    """Measures the evidence of clips.

    Args:
        model_dir: folder of the world model, loaded when a band first needs it; None: there is none.
        device: the setting `device` (core/device.py), where the world model computes.
    """

    def __init__(self, model_dir: Path | None = None, device: str = CPU) -> None:
        self._model_dir, self._device = model_dir, device
        self._models: WorldModels | None = None
        self._one_at_a_time = threading.Lock()

    def check(self, rubric: Rubric) -> None:
        """Refuse bands of unmeasured evidence. Raises ValueError: names it and the remedy. ModelFolderError."""
        if unknown := sorted(set(rubric.evidence) - pixel_names() - set(MODEL_EVIDENCE)):
            raise ValueError(
                f"rubric {rubric.version} has bands of {', '.join(unknown)}, which is not measured here; known: "
                f"{', '.join(sorted({*pixel_names(), *MODEL_EVIDENCE}))}"
            )
        asked = sorted(set(rubric.evidence) & set(MODEL_EVIDENCE))
        if asked and self._model_dir is None:
            raise ValueError(
                f"rubric {rubric.version} has bands of {', '.join(asked)}, which a world model measures; name its "
                "folder in model_dir, or take another rubric"
            )
        if asked:
            self._load()

    def measure(self, rubric: Rubric, clip: ClipRef, task: TaskSpec) -> dict[str, float]:
        """Measure the evidence of one clip that the rubric's bands name; NaN, outside every band, where impossible."""
        evidence = dict.fromkeys(rubric.evidence, math.nan)
        with self._one_at_a_time:
            if evidence.keys() & pixel_names():
                evidence |= self._measure_pixels(clip, task)
            if evidence.keys() & set(MODEL_EVIDENCE):
                evidence |= self._measure_model(clip, task)
        return {name: evidence[name] for name in rubric.evidence}

    def _measure_pixels(self, clip: ClipRef, task: TaskSpec) -> dict[str, float]:
        try:
            return pixel_evidence(pictures_of(clip.frames, task.reference_frame))
        except ValueError:  # of another shape than its reference frame, or no pictures: the agent says so
            return {}

    def _measure_model(self, clip: ClipRef, task: TaskSpec) -> dict[str, float]:
        try:
            return model_evidence(self._load(), clip.frames, task)
        except ValueError:  # of other cameras, another task, or without its actions
            return {}

    def _load(self) -> WorldModels:
        assert self._model_dir is not None  # check refuses such bands
        if self._models is None:
            self._models = load_model_folder(self._model_dir, compute_device(self._device))
        return self._models


@functools.cache
def pixel_names() -> frozenset[str]:
    """The evidence that needs no model; docs/embedded_judge_evidence.csv says what each is."""
    black = np.zeros((2, 8, 8, 3), np.uint8)
    return frozenset(pixel_evidence(pictures_of(black, black[0])))
