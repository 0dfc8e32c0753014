"""Every recipe with its ranges and the labels it forces, and how one is applied (RA-21).

Everything random of an edit comes from (SHA-256 of the parent, recipe, severity, seed). A mild edit is a fault that
must still pass: it changes no label, so that no judge wins by seeing that a clip was edited at all.
"""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from wm_nodes.config.tasks import clip_rules
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.judge.dataset.edits import physics, pixels, timing
from wm_nodes.judge.dataset.edits.clips import (
    PHYSICS,
    ClipTruth,
    Component,
    Edit,
    LabelledClip,
    NotApplicableError,
    Pattern,
    SceneStates,
    Severity,
    SourceClip,
)
from wm_nodes.judge.dataset.edits.truth import failed_physics, tc_level

REVISION = 2
"""Counted up whenever code changes what a recipe draws or what truth.py says; recipes_sha sees ranges by itself."""
SEEN_LEVELS = 8
"""A channel that changes by more, of 255, can be seen."""
SEEN_SHARE = 0.0005
"""A failing edit changes at least this share of all pixels visibly: 5 of 96 x 96 in every frame."""

Range = tuple[float, float]


@dataclass(frozen=True)
class Recipe:
    """One way of being wrong.

    kind: P pixels, T time, S states. mild, fail: ranges that `amount` is drawn from, evenly, in `unit`.
    fails: components that a failing version fails. unknown: those it makes ambiguous, where they do not fail anyway.
    tc_cap: TC level that a failing version cannot exceed. pattern: the hacking pattern it is.
    hides_motion: a failing version leaves out frames, so that a failure of physics may not be in it any more.
    on_defect: a failing version is only made of clips in which physics fails: hiding must pay if the judge is weak.
    on_success: only made of clips in which the task is completed.
    """

    name: str
    kind: Literal["P", "T", "S"]
    edit: Callable[[Any, float, np.random.Generator], Any] = field(repr=False)
    mild: Range
    fail: Range
    unit: str
    fails: tuple[Component, ...] = ()
    unknown: tuple[Component, ...] = ()
    tc_cap: int = 4
    pattern: Pattern | None = None
    hides_motion: bool = False
    on_defect: bool = False
    on_success: bool = False


_ALL = (
    Recipe("blur", "P", pixels.blur_all, (0.4, 0.5), (1.1, 2.2), "px", ("clarity",)),
    Recipe("dark", "P", pixels.expose, (0.82, 0.92), (0.25, 0.5), "gain", ("brightness",)),
    Recipe("bright", "P", pixels.expose, (1.04, 1.1), (1.7, 2.3), "gain", ("brightness",)),
    Recipe("hue_drift", "P", pixels.drift_hue, (1, 5), (22, 80), "degrees", ("color",)),
    Recipe("flicker", "P", pixels.flicker, (0.02, 0.04), (0.2, 0.45), "gain", ("temporal",), ("brightness",)),
    Recipe("object_recolour", "P", pixels.recolour_object, (1, 5), (60, 180), "degrees", ("objective",)),
    Recipe("object_vanish", "P", pixels.vanish_object, (0.03, 0.08), (0.95, 1), "opacity", ("objective",), PHYSICS, 1),
    Recipe("object_copy", "P", pixels.copy_object, (0.02, 0.04), (0.95, 1), "opacity", ("deformation",),
           ("objective", "interaction", "geometry"), pattern="physics"),
    Recipe("arm_tint", "P", pixels.tint_robot, (0.02, 0.05), (0.5, 0.9), "opacity", ("robot",), ("color",)),
    Recipe("arm_cut", "P", pixels.cut_robot, (0.01, 0.02), (0.25, 0.5), "of the arm", ("robot",), PHYSICS),
    Recipe("camera_shift", "P", pixels.shift_camera, (0.02, 0.04), (0.5, 1.2), "of 20 px", ("viewpoint",)),
    Recipe("camera_roll", "P", pixels.roll_camera, (0.02, 0.04), (0.5, 1.2), "of 25 degrees", ("viewpoint",)),
    Recipe("camera_zoom", "P", pixels.zoom_camera, (0.02, 0.04), (0.5, 1.2), "of x1.6", ("viewpoint",)),
    Recipe("shuffle", "T", timing.shuffle, (0.05, 0.1), (0.6, 1), "of the frames", ("temporal",), ("interaction",)),
    Recipe("drop", "T", timing.drop, (0.03, 0.06), (0.35, 0.5), "of the frames", ("temporal",), ("interaction",),
           hides_motion=True),
    Recipe("repeat", "T", timing.repeat, (0.03, 0.06), (0.3, 0.5), "of the frames", ("temporal",), ("interaction",),
           hides_motion=True),
    # Visual occlusion
    Recipe("occlude_patch", "P", pixels.hide_contact, (0.04, 0.08), (0.9, 1), "opacity", ("clarity",), ("brightness",),
           pattern="occlusion", on_defect=True),
    Recipe("occlude_blur", "P", pixels.blur_all, (0.4, 0.5), (1.4, 2.5), "px", ("clarity",), pattern="occlusion",
           on_defect=True),
    Recipe("occlude_shadow", "P", pixels.cast_shadow, (0.03, 0.08), (0.85, 1), "opacity", ("clarity",),
           ("brightness",), pattern="occlusion", on_defect=True),
    # Motion degradation. A clip that stands still is a TC failure (RA-21) and a temporal one by the rubric.
    Recipe("freeze", "T", timing.freeze, (0.05, 0.1), (1, 1), "of the clip", unknown=("temporal",), tc_cap=2,
           pattern="motion", hides_motion=True),
    Recipe("slow", "T", timing.slow, (0.04, 0.07), (0.6, 0.8), "of the motion", unknown=("temporal",), tc_cap=2,
           pattern="motion", hides_motion=True),
    Recipe("jitter", "T", timing.jitter, (0.1, 0.25), (0.8, 1.2), "px", unknown=("temporal",), tc_cap=2,
           pattern="motion", hides_motion=True),
    Recipe("splice", "T", timing.splice, (0.05, 0.1), (0.8, 0.95), "of the clip", ("temporal",), ("interaction",),
           1, "motion", hides_motion=True, on_success=True),
    # Background simplification
    Recipe("flatten", "P", pixels.flatten_background, (0.03, 0.08), (0.9, 1), "of the way", ("background",),
           pattern="background"),
    Recipe("smooth", "P", pixels.smooth_background, (0.4, 0.5), (4, 8), "px", ("background",), pattern="background"),
    Recipe("declutter", "P", pixels.remove_clutter, (0.02, 0.06), (0.95, 1), "opacity", ("background",),
           pattern="background"),
    Recipe("table_swap", "P", pixels.swap_table, (1, 4), (40, 90), "grey levels", ("background",), ("color",),
           pattern="background"),
    # Physical invalidation
    Recipe("ghost_motion", "S", physics.ghost_motion, (0.01, 0.03), (1, 1), "of the path", ("interaction",),
           pattern="physics"),
    # Geometry fails where truth.py sees the overlap; a fast tool may be before and behind in neighbouring frames.
    Recipe("pass_through", "S", physics.pass_through, (0.01, 0.03), (1, 1), "of the path", ("interaction",),
           ("geometry",), pattern="physics"),
    Recipe("early_motion", "S", physics.early_motion, (0.05, 0.2), (3, 5), "frames", ("interaction",),
           pattern="physics"),
    Recipe("teleport", "S", physics.teleport, (0.0015, 0.003), (0.045, 0.06), "m", ("interaction",), pattern="physics"),
    Recipe("sunk", "S", physics.sink, (0.001, 0.002), (0.014, 0.02), "m", ("geometry",), pattern="physics"),
    Recipe("pulled_in", "S", physics.pull_in, (0.02, 0.06), (0.65, 0.85), "of the way", ("geometry",),
           ("interaction",), pattern="physics"),
    Recipe("stretch", "S", physics.stretch, (0.02, 0.05), (0.5, 0.9), "of the size", ("deformation",),
           ("geometry",), pattern="physics"),
    Recipe("second_copy", "S", physics.second_copy, (0.001, 0.002), (0.055, 0.08), "m", ("deformation",),
           ("objective", "interaction", "geometry"), pattern="physics"),
    Recipe("levitation", "S", physics.levitation, (0.001, 0.003), (0.03, 0.06), "m", ("interaction", "geometry"),
           pattern="physics"),
)
RECIPES = {recipe.name: recipe for recipe in _ALL}
"""What a failing version forces, and what it leaves open, is written here and nowhere else."""


def recipes_sha() -> str:
    """SHA-256 over REVISION, every range and every forced label: clips of another value are other clips."""
    table = [{name: value for name, value in vars(recipe).items() if name != "edit"} for recipe in _ALL]
    return hashlib.sha256(json.dumps([REVISION, table], sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, eq=False)
class StateEdit:
    """States to render, and the edit they come from; `rendered` takes them back as a clip."""

    states: SceneStates
    edit: Edit


def apply(parent: LabelledClip, name: str, severity: Severity, seed: int) -> LabelledClip:
    """Edit pixels or time.

    Raises:
        ValueError: no such recipe or severity, or a recipe on states: those must be rendered, see edit_states.
        NotApplicableError: this clip has nothing that the recipe could work on.
    """
    recipe = get_recipe(name)
    if recipe.kind == "S":
        raise ValueError(f"recipe {name!r} edits states; use edit_states, render them, then rendered")
    amount, rng = _draw_amount(parent, recipe, severity, seed)
    return _make_child(parent, recipe.edit(parent.clip, amount, rng), Edit(name, severity, seed, amount))


def edit_states(parent: LabelledClip, name: str, severity: Severity, seed: int) -> StateEdit:
    """Edit states; a pure function of the recorded ones.

    Raises:
        ValueError: no such recipe or severity, or one that edits pixels or time, or a clip whose picture was edited
            already: rendering it again would undo that.
        NotApplicableError: as apply.
    """
    recipe = get_recipe(name)
    if recipe.kind != "S":
        raise ValueError(f"recipe {name!r} edits frames; use apply")
    if any(get_recipe(edit.recipe).kind != "S" for edit in parent.edits):
        raise ValueError(f"the clip's picture was edited by {parent.recipe!r}; edit states before pixels and time")
    amount, rng = _draw_amount(parent, recipe, severity, seed)
    return StateEdit(recipe.edit(parent.clip.states, amount, rng), Edit(name, severity, seed, amount))


def label_rendered(parent: LabelledClip, edited: StateEdit, clip: SourceClip) -> LabelledClip:
    """Label the clip that was rendered from edited states. Raises NotApplicableError: as apply."""
    return _make_child(parent, clip, edited.edit)


def get_recipe(name: str) -> Recipe:
    if name not in RECIPES:
        raise ValueError(f"unknown recipe {name!r}; choose one of {', '.join(RECIPES)}")
    return RECIPES[name]


def _draw_amount(
    parent: LabelledClip, recipe: Recipe, severity: Severity, seed: int
) -> tuple[float, np.random.Generator]:
    if severity not in ("mild", "fail"):
        raise ValueError(f"severity must be mild or fail, got {severity!r}")
    defect = any(parent.labels.components.get(name) is False for name in PHYSICS)
    if severity == "fail" and recipe.on_defect and not defect:
        raise NotApplicableError(f"{recipe.name} hides a physical defect, this clip has none; use a state recipe first")
    if severity == "fail" and recipe.on_success and parent.labels.tc_level < 4:
        raise NotApplicableError(f"{recipe.name} needs a completed task, got level {parent.labels.tc_level}")
    rng = numpy_stream(seed, f"adversarial/{parent.sha256}/{recipe.name}/{severity}")
    low, high = recipe.mild if severity == "mild" else recipe.fail
    return float(rng.uniform(low, high)), rng


def _make_child(parent: LabelledClip, clip: SourceClip, edit: Edit) -> LabelledClip:
    recipe = get_recipe(edit.recipe)
    labels = _failed_labels(parent, clip, recipe) if edit.severity == "fail" else _unchanged_labels(parent, clip)
    child = LabelledClip(clip, labels, (*parent.edits, edit), parent.root)
    if child.sha256 == parent.sha256 or (edit.severity == "fail" and seen_share(parent.clip, clip) < SEEN_SHARE):
        raise NotApplicableError(f"{recipe.name} ({edit.severity}) changes nothing in this clip that could be seen")
    return child


def _failed_labels(parent: LabelledClip, clip: SourceClip, recipe: Recipe) -> ClipTruth:
    """Forced failures; what the states break besides; what nobody can tell is left out."""
    components = dict(parent.labels.components)
    if recipe.hides_motion:
        components = {name: passed for name, passed in components.items() if passed or name not in PHYSICS}
    components = {name: passed for name, passed in components.items() if not passed or name not in recipe.unknown}
    broken = _new_failures(parent, clip) if recipe.kind == "S" else frozenset[Component]()
    components |= dict.fromkeys((*recipe.fails, *broken), False)
    level = parent.labels.tc_level
    if recipe.kind != "P":  # other states at the end, or other frames
        level = min(_truth_level(clip), level) if recipe.kind == "T" else _truth_level(clip)
    return ClipTruth(components, min(level, recipe.tc_cap), recipe.pattern or parent.labels.pattern)


def _unchanged_labels(parent: LabelledClip, clip: SourceClip) -> ClipTruth:
    """The parent's labels, where the end of the clip is still worth the same and no physics broke."""
    if _truth_level(clip) != _truth_level(parent.clip):
        raise NotApplicableError("even a mild edit changes how far the task gets in this clip")
    if not parent.edits and (fresh := _new_failures(parent, clip)):
        raise NotApplicableError(f"even a mild edit breaks {', '.join(sorted(fresh))} in this clip")
    return parent.labels


def _new_failures(parent: LabelledClip, clip: SourceClip) -> frozenset[Component]:
    """What the parent's states show is in its labels, or it is what the simulator did."""
    return failed_physics(clip.states) - failed_physics(parent.clip.states)


def seen_share(before: SourceClip, after: SourceClip) -> float:
    """Share of pixels, over all frames, that differ by more than SEEN_LEVELS in a channel."""
    change = np.abs(before.frames.astype(np.int16) - after.frames).max(-1)
    return float((change > SEEN_LEVELS).mean())


def _truth_level(clip: SourceClip) -> int:
    return tc_level(clip.states, clip_rules(clip.origin.task).label)

