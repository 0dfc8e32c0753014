"""A sixth shape is one file: written to a package of its own, it is named, simulated, grasped, pushed and recorded."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from own_packages import own_package

from wm_nodes.config.load import ConfigError, load_config
from wm_nodes.config.scenes import SHAPES_VARIABLE, scenes_of
from wm_nodes.environments.maniskill.objects import BOTTOM
from wm_nodes.environments.maniskill.shape import get_shape
from wm_nodes.environments.record import collect_plan, demonstration_plan
from wm_nodes.recording import read_episodes

pytestmark = pytest.mark.rendering
SCENE = "red_post-plate-grey_table"
POST = '''
"""A post that stands."""
import numpy as np

from wm_nodes.environments.maniskill.shape import Shape

HALF_M = [0.018, 0.018, 0.03]


def build(builder, material):
    builder.add_box_collision(half_size=HALF_M)
    builder.add_box_visual(half_size=HALF_M, material=material)


SHAPE = Shape(build, rest_height_m=0.03, lowest_m=lambda up: float(np.abs(up) @ HALF_M))
'''


@pytest.fixture(scope="module", autouse=True)
def shape_file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with own_package(tmp_path_factory.mktemp("packages"), "furniture", SHAPES_VARIABLE, post=POST, nothing=""):
        yield
    get_shape.cache_clear()


@pytest.mark.parametrize("task", ["push", "pick_place"])
def test_its_demonstrations_are_recorded_in_its_scenes(task: str, tmp_path: Path) -> None:
    config = load_config("smoke", {"task": task, "simulation.scenes": SCENE, "data.num_workers": 1})
    bags = collect_plan(demonstration_plan(config, 1, 600_000), config, tmp_path)
    (episode,) = read_episodes(bags[0])
    assert "red post" in episode.instruction and episode.success[-1]
    red = episode.images[0, :, :64].astype(int)
    assert (red[..., 0] > np.maximum(red[..., 1], red[..., 2]) + 50).sum() > 20
    assert abs(episode.ground_truth[0, BOTTOM]) < 1e-3


def test_an_unknown_shape_and_a_file_without_one_are_named() -> None:
    assert [scene.shape for scene in scenes_of(SCENE)] == ["post"]
    with pytest.raises(ConfigError, match=r"unknown scenes 'red_vase-plate-grey_table'.* post"):
        load_config("smoke", {"task": "push", "simulation.scenes": "red_vase-plate-grey_table"})
    with pytest.raises(ValueError, match=r"unknown shape 'vase'; choose one of .*post"):
        get_shape("vase")
    with pytest.raises(ValueError, match=r"nothing.py has no SHAPE = Shape\(...\)"):
        get_shape("nothing")
