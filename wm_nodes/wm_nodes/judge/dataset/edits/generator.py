"""From one recorded clip to its edited children: every recipe, mild and failing, wherever it applies, and mild ones on
top of each other (RA-21).
"""

import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress

import numpy as np

from wm_nodes.core.seeding import numpy_stream
from wm_nodes.judge.dataset.edits.clips import Component, Edit, LabelledClip, NotApplicableError, Severity
from wm_nodes.judge.dataset.edits.recipes import RECIPES, StateEdit, apply, edit_states, get_recipe

Redraw = Callable[[LabelledClip, StateEdit], LabelledClip]
"""Renders edited states of a clip and labels the result: recipes.rendered with a simulator, or a toy, behind it."""
SEVERITIES: tuple[Severity, ...] = ("mild", "fail")
STATE_RECIPES = tuple(recipe.name for recipe in RECIPES.values() if recipe.kind == "S")
FRAME_RECIPES = tuple(recipe.name for recipe in RECIPES.values() if recipe.kind != "S")
"""Those on states, which must be drawn again; those on pixels and time."""
MOST_STACKED = 3
"""Mild edits of a stack."""


def children(
    parent: LabelledClip, seed: int, redraw: Redraw | None, *, names: Sequence[str] = tuple(RECIPES),
    count: int | None = None, skipped: Counter[str] | None = None,
) -> Iterator[LabelledClip]:
    """Yield edited clips, no picture twice.

    What hides a physical defect is applied to a child that has one: of a failing state recipe drawn by the seed.

    Args:
        redraw: None where nothing can be rendered; then state recipes, and failing ones on a defect, are left out.
        names: recipes to use. count: that many (recipe, severity) pairs, drawn by the seed; None: all.
        skipped: counts the reasons for which a pair gave no clip.

    Raises:
        ValueError: an unknown recipe.
    """
    recipes = [get_recipe(name) for name in names]
    pairs = list(itertools.product(recipes, SEVERITIES))
    rng = numpy_stream(seed, f"adversarial_children/{parent.sha256}")
    if count is not None:
        pairs = [pairs[i] for i in sorted(rng.permutation(len(pairs))[:count])]
    seen, defect = {parent.sha256}, None
    for recipe, severity in pairs:
        on_defect = recipe.on_defect and severity == "fail"
        try:
            if on_defect and defect is None:
                defect = _make_defect(parent, seed, redraw)
            child = apply_edit(defect if on_defect and defect else parent, recipe.name, severity, seed, redraw)
        except NotApplicableError as reason:
            if skipped is not None:
                skipped[f"{recipe.name} {severity}: {reason}"] += 1
            continue
        if child.sha256 not in seen:
            seen.add(child.sha256)
            yield child


def stacks(
    parent: LabelledClip, seed: int, redraw: Redraw, count: int, *, skipped: Counter[str] | None = None
) -> Iterator[LabelledClip]:
    """Yield edited clips with one to MOST_STACKED mild edits of pixels and time on top of each other, no picture twice.

    Every other one has a failing physical defect below them. No two edits of a stack touch the same component, since
    two slight faults may be a clear one. A search that climbs a judge's reward makes such clips (reward_hacking).

    Args:
        count: stacks that are tried. skipped: see children.
    """
    seen = {parent.sha256}
    for index in range(count):
        rng = numpy_stream(seed, f"adversarial_stack/{parent.sha256}/{index}")
        try:
            clip = _make_defect(parent, int(rng.integers(2**31)), redraw) if index % 2 else parent
        except NotApplicableError as reason:
            if skipped is not None:
                skipped[f"stack: {reason}"] += 1
            continue
        clip = _stack(clip, rng)
        if clip.sha256 not in seen:
            seen.add(clip.sha256)
            yield clip


def _stack(clip: LabelledClip, rng: np.random.Generator) -> LabelledClip:
    """The clip with as many mild edits as `rng` draws, or as apply to it."""
    missing, touched = 1 + rng.integers(MOST_STACKED), set[Component]()
    for place in rng.permutation(len(FRAME_RECIPES)):
        recipe = get_recipe(FRAME_RECIPES[place])
        if not touched.isdisjoint(recipe.fails):
            continue
        with suppress(NotApplicableError):
            clip = apply(clip, recipe.name, "mild", int(rng.integers(2**31)))
            touched.update(recipe.fails)
            missing -= 1
        if not missing:
            break
    return clip


def apply_edit(parent: LabelledClip, name: str, severity: Severity, seed: int, redraw: Redraw | None) -> LabelledClip:
    """Apply one recipe of any kind. Raises NotApplicableError: as recipes.apply, or no renderer for a state recipe."""
    if get_recipe(name).kind != "S":
        return apply(parent, name, severity, seed)
    if redraw is None:
        raise NotApplicableError("there is no renderer for edited states")
    return redraw(parent, edit_states(parent, name, severity, seed))


def replay(root: LabelledClip, edits: Sequence[Edit], redraw: Redraw | None) -> LabelledClip:
    """The clip that a chain of edits makes of its recorded clip."""
    clip = root
    for edit in edits:
        clip = apply_edit(clip, edit.recipe, edit.severity, edit.seed, redraw)
    return clip


def _make_defect(parent: LabelledClip, seed: int, redraw: Redraw | None) -> LabelledClip:
    """A child in which physics fails, by a recipe drawn by the seed."""
    for index in numpy_stream(seed, f"adversarial_defect/{parent.sha256}").permutation(len(STATE_RECIPES)):
        try:
            return apply_edit(parent, STATE_RECIPES[index], "fail", seed, redraw)
        except NotApplicableError:
            continue
    raise NotApplicableError("no state recipe makes a physical defect of this clip, so there is none to hide")
