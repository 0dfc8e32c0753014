"""Starts files: frames and states of real episodes to imagine from, and what else is known of each of them.

Shapes: M starts, H W 3 image, P state.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wm_nodes.config.tasks import parts_of, shares_scene
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import Episode, FloatArray, UInt8Array, UInt64Array
from wm_nodes.training.checkpoint import read_tensors
from wm_nodes.world_model.text import instruction_for

STARTS_REMEDY = "copy the model folder again; one in a run folder is written again after it was deleted"
INSTRUCTIONS = "instructions"
"""Key of a starts file, see pack_instructions."""


def load_starts(path: Path, task: str = "") -> tuple[UInt8Array, FloatArray]:
    """Real frames uint8 (M, H, W, 3) and states float32 (M, P) to imagine from, those in the scene of `task`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it is no starts file, or none of its starts is in that scene.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no starts file {path}; {STARTS_REMEDY}")
    tensors = read_tensors(path, STARTS_REMEDY)
    missing = {"images", "states"} - tensors.keys()
    if missing or not len(tensors["images"]):
        raise ValueError(f"{path} is no starts file: it must hold images and states of at least one first frame")
    rows = _rows(path, tensors, task)
    images, states = (tensors[name].numpy()[rows] for name in ("images", "states"))
    if not task or (parts := parts_of(task)) == (task,) or INSTRUCTIONS not in tensors:
        return images, states
    recorded = _recorded(path, tensors)
    tasks = [recorded[row][0] for row in rows]
    if task in tasks:  # its states say which task it is
        return images, states
    codes = np.array([[part == recorded_task for part in parts] for recorded_task in tasks], np.float32)
    return images, np.concatenate([states, codes], 1)


def load_start_instructions(path: Path, spec: EnvironmentSpec) -> list[str]:
    """The instruction of every start of load_starts for the task of `spec`; that of the spec where the file has none.

    Raises:
        ValueError: as load_starts.
    """
    tensors = read_tensors(path, STARTS_REMEDY)
    rows = _rows(path, tensors, spec.task)
    if INSTRUCTIONS not in tensors:
        return [spec.instruction] * len(rows)
    recorded = _recorded(path, tensors)
    return [instruction_for(spec.task, *recorded[row], spec.instruction) for row in rows]


def load_start_seeds(path: Path, task: str = "") -> UInt64Array:
    """Reset seeds (M,) by which the simulator shows the first frames of load_starts.

    Raises:
        ValueError: a file without them: of frames in the middle of an episode.
    """
    tensors = read_tensors(path, STARTS_REMEDY)
    if "seeds" not in tensors:
        raise ValueError(f"{path} holds no reset seeds of first frames; delete it to have it written again, with "
                         "data.start_frames first")
    return np.asarray(tensors["seeds"].numpy()[_rows(path, tensors, task)], np.uint64)


def starts_of(seeds: UInt64Array, num_starts: int) -> NDArray[np.int64]:
    """The starts at which resets with these seeds begin; those of M seeds in a row are all M, each once."""
    return (seeds % np.uint64(num_starts)).astype(np.int64)


def pack_instructions(episodes: Sequence[Episode]) -> Tensor:
    """The instructions of a starts file, uint8: the UTF-8 bytes of a JSON list of (recorded task, instruction)."""
    return _packed([(episode.task, episode.instruction) for episode in episodes])


def join_starts(*paths: Path) -> dict[str, Tensor]:
    """The tensors of one starts file with the starts of several, without reset seeds.

    Raises:
        ValueError: a file without instructions.
    """
    files = [read_tensors(path, STARTS_REMEDY) for path in paths]
    for path, tensors in zip(paths, files, strict=True):
        if INSTRUCTIONS not in tensors:
            raise ValueError(f"{path} has no instructions; delete it to have it written again")
    recorded = [entry for path, tensors in zip(paths, files, strict=True) for entry in _recorded(path, tensors)]
    joined = {name: torch.cat([tensors[name] for tensors in files]) for name in ("images", "states")}
    return {**joined, INSTRUCTIONS: _packed(recorded)}


def _rows(path: Path, tensors: Mapping[str, Tensor], task: str) -> list[int]:
    """Numbers of the starts in the scene of `task`; all of them for "", or where it is not known what they are of."""
    if not task or INSTRUCTIONS not in tensors:
        return list(range(len(tensors["images"])))
    tasks = [recorded_task for recorded_task, _ in _recorded(path, tensors)]
    if rows := [row for row, recorded_task in enumerate(tasks) if shares_scene(recorded_task, task)]:
        return rows
    raise ValueError(f"{path} has starts of {', '.join(sorted(set(tasks)))}, none of {task}")


def _recorded(path: Path, tensors: Mapping[str, Tensor]) -> list[tuple[str, str]]:
    """(recorded task, instruction) of every start. Raises ValueError: not as many as there are starts."""
    recorded, count = json.loads(tensors[INSTRUCTIONS].numpy().tobytes()), len(tensors["images"])
    if len(recorded) != count:
        raise ValueError(
            f"{path} has {len(recorded)} instructions for {count} starts; delete it to have it written again"
        )
    return [(task, instruction) for task, instruction in recorded]


def _packed(recorded: Sequence[tuple[str, str]]) -> Tensor:
    return torch.tensor(list(json.dumps(recorded).encode()), dtype=torch.uint8)
