"""The embedded judge of a world model whose done signal is told where things are: it reads that off the clip."""

from pathlib import Path

import numpy as np
import pytest

from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.types import FloatArray, UInt8Array
from wm_nodes.environments.object_reader import ObjectReader, reader_of
from wm_nodes.judge.one_class.imagination import model_numbers
from wm_nodes.judge.one_class.ranges import load_ranges
from wm_nodes.world_model import WorldModels, load_model_folder
from wm_nodes.world_model.starts import load_starts

STEPS, TASK = 8, "push"


class ToldReader(ObjectReader):
    """Says that the object has moved along x by `way` in the middle of the clip, and lies still."""

    way, moving = 0.0, 0

    def fill(self, images: UInt8Array, states: FloatArray) -> FloatArray:
        filled = super().fill(images[:1].repeat(len(images), 0), states)
        filled[:, self.moving] += np.linspace(0, 2 * self.way, len(images)).clip(max=self.way)
        return filled


@pytest.fixture(scope="module")
def models() -> WorldModels:
    return load_model_folder(shipped_model(TASK))


def still(folder: Path) -> UInt8Array:
    """A clip in which nothing moves."""
    return load_starts(folder / "starts.safetensors", TASK)[0][:1].repeat(STEPS, 0)


@pytest.mark.parametrize("stride", [1, 2])
def test_what_is_done_is_read_off_the_clip(models: WorldModels, stride: int) -> None:
    folder = shipped_model(TASK)
    ranges, frames = load_ranges(folder, 1), still(folder)
    reader = ToldReader(models.spec)
    found = reader_of(folder, models.spec)
    assert found is not None
    reader.load_state_dict(found.state_dict())
    reader.moving = models.spec.state_names.index("object_x")
    done = dict[float, float]()
    for way in (0.0, 0.2):
        reader.way = way
        _, signals = model_numbers(
            models, frames, stride, np.asarray(ranges.origin, np.float32), ranges.height_m, reader
        )
        done[way] = signals[TASK]
    assert done[0.0] < 0.05 < 0.95 < done[0.2]
