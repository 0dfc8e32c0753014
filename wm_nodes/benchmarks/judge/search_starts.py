"""Clips to begin a search with: recorded anew from a set's origins, good but for one physical defect."""

from collections.abc import Iterator, Sequence

from benchmarks.judge.hacking import SearchStart
from wm_nodes.config.schema import SimulationConfig
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.judge.dataset.build import LabelledClipSource
from wm_nodes.judge.dataset.edits.clips import LabelledClip, NotApplicableError
from wm_nodes.judge.dataset.edits.generator import STATE_RECIPES, apply_edit
from wm_nodes.judge.dataset.edits.manifest import Division, ManifestError, ManifestRow


def hacking_starts(
    rows: Sequence[ManifestRow], division: Division, config: SimulationConfig, seed: int
) -> Iterator[SearchStart]:
    """Yield of every recorded clip that is good throughout the one with a defect, by a recipe on states that the seed
    draws; recorded and drawn when asked for.

    Raises:
        ManifestError: a recorded clip comes out otherwise than in the set: another renderer or version.
        NoRendererError: Vulkan finds no device.
    """
    roots = [row for row in rows if not row.edits and row.labels.overall]
    shapes = {name.split("/")[0] for name in division.objects}
    for task in dict.fromkeys(row.origin.task for row in roots):
        source = LabelledClipSource(task, config, shapes)
        try:
            for row in (row for row in roots if row.origin.task == task):
                parent = source.clip(row.origin.seed)
                if parent.sha256 != row.sha256:
                    raise ManifestError(
                        f"clip {row.sha256[:12]} came out as {parent.sha256[:12]}: another renderer; build the set here"
                    )
                start = _make_defect(parent, source, seed)
                if start is not None:
                    yield SearchStart(start, parent)
        finally:
            source.close()


def _make_defect(parent: LabelledClip, source: LabelledClipSource, seed: int) -> LabelledClip | None:
    for index in numpy_stream(seed, f"hack_start/{parent.sha256}").permutation(len(STATE_RECIPES)):
        try:
            return apply_edit(parent, STATE_RECIPES[index], "fail", seed, source.redraw)
        except NotApplicableError:
            continue
    return None
