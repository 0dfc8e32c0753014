"""From one recorded clip to its edited children: every recipe, mild and failing, wherever it applies. Section 3.1."""

import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Sequence

from wm_nodes.reward.adversarial.clips import Edit, LabelledClip, NotApplicableError, Severity
from wm_nodes.reward.adversarial.recipes import RECIPES, StateEdit, apply, edit_states, get_recipe
from wm_nodes.seeding import numpy_stream

Redraw = Callable[[LabelledClip, StateEdit], LabelledClip]
"""Renders edited states of a clip and labels the result: recipes.rendered with a simulator, or a toy, behind it."""
SEVERITIES: tuple[Severity, ...] = ("mild", "fail")


def children(
    parent: LabelledClip,
    seed: int,
    redraw: Redraw | None,
    *,
    names: Sequence[str] = tuple(RECIPES),
    count: int | None = None,
    skipped: Counter[str] | None = None,
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
                defect = _defective(parent, seed, redraw)
            child = edited(defect if on_defect and defect else parent, recipe.name, severity, seed, redraw)
        except NotApplicableError as reason:
            if skipped is not None:
                skipped[f"{recipe.name} {severity}: {reason}"] += 1
            continue
        if child.sha256 not in seen:
            seen.add(child.sha256)
            yield child


def edited(
    parent: LabelledClip, name: str, severity: Severity, seed: int, redraw: Redraw | None
) -> LabelledClip:
    """Apply one recipe of any kind.

    Raises:
        NotApplicableError: as recipes.apply, or a state recipe where nothing can be rendered.
    """
    if get_recipe(name).kind != "S":
        return apply(parent, name, severity, seed)
    if redraw is None:
        raise NotApplicableError("there is no renderer for edited states")
    return redraw(parent, edit_states(parent, name, severity, seed))


def replay(root: LabelledClip, edits: Sequence[Edit], redraw: Redraw | None) -> LabelledClip:
    """The clip that a chain of edits makes of its recorded clip."""
    clip = root
    for edit in edits:
        clip = edited(clip, edit.recipe, edit.severity, edit.seed, redraw)
    return clip


def _defective(parent: LabelledClip, seed: int, redraw: Redraw | None) -> LabelledClip:
    """A child in which physics fails, by a recipe drawn by the seed."""
    names = [recipe.name for recipe in RECIPES.values() if recipe.kind == "S"]
    for index in numpy_stream(seed, f"adversarial_defect/{parent.sha256}").permutation(len(names)):
        try:
            return edited(parent, names[index], "fail", seed, redraw)
        except NotApplicableError:
            continue
    raise NotApplicableError("no state recipe makes a physical defect of this clip, so there is none to hide")
