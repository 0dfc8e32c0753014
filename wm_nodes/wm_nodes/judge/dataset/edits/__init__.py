"""Clips that are wrong in a known way: recipes on pixels, time and states, their labels, the manifest of a set.

See RA-21. Pure functions of arrays: what renders edited states is elsewhere.
"""

from wm_nodes.judge.dataset.edits.clips import (
    BACKGROUND,
    COMPONENTS,
    DISTRACTOR,
    OBJECT,
    PHYSICS,
    ROBOT,
    TC,
    ClipTruth,
    Edit,
    LabelledClip,
    NotApplicableError,
    Origin,
    SceneStates,
    SourceClip,
)
from wm_nodes.judge.dataset.edits.generator import Redraw, children, replay, stacks
from wm_nodes.judge.dataset.edits.manifest import (
    SPLITS,
    Division,
    Manifest,
    ManifestError,
    from_bytes,
    manifest_of,
    prevalence,
    regenerate,
    to_bytes,
)
from wm_nodes.judge.dataset.edits.planning import planning_level
from wm_nodes.judge.dataset.edits.recipes import (
    RECIPES,
    Recipe,
    StateEdit,
    apply,
    edit_states,
    label_rendered,
    recipes_sha,
)
from wm_nodes.judge.dataset.edits.truth import failed_physics, recorded, tc_level

__all__ = [
    "BACKGROUND",
    "COMPONENTS",
    "DISTRACTOR",
    "OBJECT",
    "PHYSICS",
    "RECIPES",
    "ROBOT",
    "SPLITS",
    "TC",
    "ClipTruth",
    "Division",
    "Edit",
    "LabelledClip",
    "Manifest",
    "ManifestError",
    "NotApplicableError",
    "Origin",
    "Recipe",
    "Redraw",
    "SceneStates",
    "SourceClip",
    "StateEdit",
    "apply",
    "children",
    "edit_states",
    "failed_physics",
    "from_bytes",
    "label_rendered",
    "manifest_of",
    "planning_level",
    "prevalence",
    "recipes_sha",
    "recorded",
    "regenerate",
    "replay",
    "stacks",
    "tc_level",
    "to_bytes",
]
