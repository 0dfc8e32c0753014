"""The planning level that a clip truly has, from its recipes and labels (RA-21).

L0 invalid, L1 poor, L2 fair, L3 good, as the robot rubric describes them. The paper names no classes; which label
gives which level is our choice: a picture that stands still is L0 by the rubric's own words; a fault of the picture
that every part of the scene shares leaves it "in large parts unreadable"; everything else that fails is "a clear local
fault". How far the task got is no matter of planning: a clean clip of a failed push is good.
"""

from collections.abc import Sequence

from wm_nodes.judge.dataset.edits.clips import COMPONENTS, ClipTruth, Component, Edit
from wm_nodes.judge.dataset.edits.recipes import get_recipe

INVALID, POOR, FAIR, GOOD = range(4)
STILL = frozenset({"freeze", "jitter"})
"""Recipes whose failing version shows one picture."""
PATCHES = frozenset({"occlude_patch", "occlude_shadow"})
"""Recipes that spoil the picture in one place only."""
PICTURE: frozenset[Component] = frozenset({"clarity", "brightness", "color", "temporal"})


def planning_level(labels: ClipTruth, edits: Sequence[Edit]) -> int | None:
    """The level 0 to 3 of a clip; None where a label that nobody knows decides it."""
    failing = [edit.recipe for edit in edits if edit.severity == "fail"]
    if STILL.intersection(failing):
        return INVALID
    if any(PICTURE.intersection(get_recipe(name).fails) for name in failing if name not in PATCHES):
        return POOR
    if not all(labels.components.values()):
        return FAIR
    return GOOD if len(labels.components) == len(COMPONENTS) else None
