"""The catalogue of the table-top scenes: which object, container and table, and which scenes train or test.

A scene's name is <colour>_<shape>-<container>-<table>, e.g. red_bar-bowl-grey_table. Every scene of SCENES is in one
split; scenes.json lists them, and what they are made of. Those of a user's own shapes are in none. Standard library
only, as tasks.py.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
import re
from dataclasses import dataclass
from importlib import resources

from wm_nodes.config.extensions import find_files

_CATALOGUE = json.loads(resources.files("wm_nodes.config").joinpath("scenes.json").read_text(encoding="utf-8"))
COLOURS, SHAPES, CONTAINERS, TABLES = (
    tuple(_CATALOGUE["parts"][name]) for name in ("colours", "shapes", "containers", "tables")
)
SHAPES_VARIABLE = "WM_SHAPES"
"""Environment variable with the names of further packages of shapes, separated by commas."""


@dataclass(frozen=True)
class Scene:
    """What lies on the table, and the table."""

    colour: str
    """Of the object."""
    shape: str
    """Of the object: a file's name."""
    container: str
    """What lies beside the object."""
    table: str
    """Its top."""

    @property
    def name(self) -> str:
        return f"{self.colour}_{self.shape}-{self.container}-{self.table}"

    @property
    def object(self) -> str:
        """The object in words."""
        return f"{self.colour} {self.shape}"


SCENES = {
    scene.name: scene
    for scene in (Scene(*parts) for parts in itertools.product(COLOURS, SHAPES, CONTAINERS, TABLES))
}


@functools.cache
def splits() -> dict[str, tuple[str, ...]]:
    """Names of the scenes by split: train, ood_object (objects that are nowhere else) and ood_combo (objects,
    containers and tables of train in combinations that are not)."""
    return {split: tuple(names) for split, names in _CATALOGUE["splits"].items()}


def scenes_of(setting: str) -> tuple[Scene, ...]:
    """The scenes of simulation.scenes: those of a split, or one by its name; () for "".

    Raises:
        ValueError: neither of them; names what is known.
    """
    if not setting:
        return ()
    if setting in splits():
        return tuple(SCENES[name] for name in splits()[setting])
    if setting in SCENES:  # as at every reset, without a look into folders
        return (SCENES[setting],)
    match = re.fullmatch(r"([^_-]+)_([^-]+)-([^-]+)-([^-]+)", setting)
    known = COLOURS, tuple(shapes()), CONTAINERS, TABLES
    if match is None or any(part not in names for part, names in zip(match.groups(), known)):
        raise ValueError(
            f"unknown scenes {setting!r}; choose a split ({', '.join(splits())}) or a scene's name, "
            f"COLOUR_SHAPE-CONTAINER-TABLE of {'; '.join(', '.join(names) for names in known)}"
        )
    return (Scene(*match.groups()),)


def shapes() -> dict[str, str]:
    """Package by shape. Raises ValueError as find_files."""
    return find_files("shape", "shapes", SHAPES_VARIABLE)


def check_scenes(setting: str) -> str:
    """Return a known setting. Raises ValueError as scenes_of."""
    scenes_of(setting)
    return setting


def scene_of(setting: str, seed: int) -> Scene | None:
    """The scene of the episode that is reset with `seed`; None for "". Raises ValueError as scenes_of."""
    scenes = scenes_of(setting)
    if not scenes:
        return None
    return scenes[draw(f"scene {seed}", len(scenes))]


def draw(name: str, count: int) -> int:
    """A number below `count` that follows from the name."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little") % count
