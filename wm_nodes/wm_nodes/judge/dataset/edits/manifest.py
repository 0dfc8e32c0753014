"""What a benchmark set consists of: recipes, hashes, labels, splits, prevalence; the pixels are made again from it.

See RA-21. JSON lines: a header, then one clip per line in the order of their hashes. Kilobytes per thousand clips,
and a text that version control can show differences of.
"""

import hashlib
import io
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

from wm_nodes.core.seeding import stream_seed
from wm_nodes.judge.dataset.edits.clips import COMPONENTS, TC, ClipTruth, Edit, LabelledClip, Origin
from wm_nodes.judge.dataset.edits.generator import Redraw, replay
from wm_nodes.judge.dataset.edits.recipes import get_recipe, recipes_sha

FORMAT = "adversarial-clips-1"
Part = Literal["train", "validation", "test"]
Split = Literal["iid", "new_object", "new_task", "new_camera", "new_scene", "hack"]
SPLITS: tuple[Split, ...] = get_args(Split)
Prevalence = dict[str, dict[str, dict[str, int]]]
"""split, or "all" -> component, task_completion or overall -> how many clips pass, fail, are unknown."""


class ManifestError(ValueError):
    """A manifest that is damaged, of another version, or not what its clips are made of."""


@dataclass(frozen=True)
class Division:
    """Who is kept away from training. tasks, cameras, objects, scenes: held out, all their clips are test clips.
    test, validation: shares of the other episodes; all clips of an episode, edited or not, go the same way.
    """

    tasks: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()
    validation: float = 0.1
    test: float = 0.3

    def __post_init__(self) -> None:
        if min(self.validation, self.test) < 0 or self.validation + self.test > 1:
            raise ValueError(f"validation {self.validation} and test {self.test} must be shares of at most 1 together")

    def held_out(self, origin: Origin) -> Split | None:
        """The split of a held-out clip; held out in several ways: of the first of task, camera, object, scene."""
        if origin.task in self.tasks:
            return "new_task"
        if origin.camera in self.cameras:
            return "new_camera"
        if origin.object_id in self.objects:
            return "new_object"
        return "new_scene" if origin.scene in self.scenes else None

    def part(self, origin: Origin) -> Part:
        """train, validation or test: drawn by task and seed, so that another camera sees the same part."""
        if self.held_out(origin):
            return "test"
        share = stream_seed(origin.seed, f"adversarial_part/{origin.task}") / 2**63
        return "test" if share < self.test else "validation" if share < self.test + self.validation else "train"


@dataclass(frozen=True)
class ManifestRow:
    """One clip. sha256: of fps and pixels. root: of the recorded clip it was made of. part, split: as Division says;
    hack are failing clips of a hacking pattern that are not held out otherwise, their clean parent is `root`.
    """

    sha256: str
    root: str
    origin: Origin
    edits: tuple[Edit, ...]
    labels: ClipTruth
    part: Part
    split: Split


@dataclass(frozen=True)
class Manifest:
    """A set of clips in the order of their hashes. recipes_sha: of the recipes they were made with."""

    division: Division
    rows: tuple[ManifestRow, ...]
    recipes_sha: str

    @property
    def prevalence(self) -> Prevalence:
        return prevalence(self.rows)


def manifest_of(clips: Iterable[LabelledClip], division: Division) -> Manifest:
    """Describe clips; equal pictures of equal labels count once. Raises ManifestError: see check."""
    rows: dict[str, ManifestRow] = {}
    for clip in clips:
        row = _row(clip, division)
        if rows.setdefault(row.sha256, row).labels != row.labels:
            raise ManifestError(
                f"clip {row.sha256[:12]} has two labels, by {_chain(rows[row.sha256])} and by {_chain(row)}; drop both"
            )
    manifest = Manifest(division, tuple(rows[sha] for sha in sorted(rows)), recipes_sha())
    check(manifest)
    return manifest


def prevalence(rows: Sequence[ManifestRow]) -> Prevalence:
    """Count labels per split and of all clips; pass + fail + unknown is the number of clips."""
    counts: Prevalence = {}
    for name in ("all", *SPLITS):
        chosen = [row for row in rows if name in ("all", row.split)]
        known = [{**row.labels.passed, "overall": row.labels.overall} for row in chosen]
        counts[name] = {}
        for component in (*COMPONENTS, TC, "overall"):
            outcomes = Counter(passed.get(component) for passed in known)
            counts[name][component] = {"pass": outcomes[True], "fail": outcomes[False], "unknown": outcomes[None]}
    return counts


def check(manifest: Manifest) -> None:
    """Check what must hold between the rows.

    Raises:
        ManifestError: a clip twice or out of order, a part or split that the division does not give, an edited clip
            whose recorded one is missing or lies in another part, a recording that fails a component although the
            simulator made it, other recipes than these.
    """
    if manifest.recipes_sha != recipes_sha():
        raise ManifestError(
            f"the manifest was made with recipes {manifest.recipes_sha[:12]}, these are {recipes_sha()[:12]}: build "
            "the set again, or take the version of the code that made it"
        )
    by_sha = {row.sha256: row for row in manifest.rows}
    if [row.sha256 for row in manifest.rows] != sorted(by_sha):
        raise ManifestError("the clips are not in order of their hashes, or one is there twice; build the set again")
    for row in manifest.rows:
        if (row.part, row.split) != _part_and_split(row.origin, row.edits, row.labels, manifest.division):
            raise ManifestError(f"clip {row.sha256[:12]} is not of {row.part}, {row.split}; build the set again")
        root = by_sha.get(row.root)
        if root is None or root.edits:
            raise ManifestError(f"clip {row.sha256[:12]} lacks its recorded clip {row.root[:12]}; add that, unedited")
        if root.origin != row.origin:
            raise ManifestError(f"clip {row.sha256[:12]} has another origin than its recording; build the set again")
        if not row.edits and not all(row.labels.components.values()):
            raise ManifestError(f"recording {row.sha256[:12]} fails what the simulator made; build the set again")


def to_bytes(manifest: Manifest) -> bytes:
    """The file of a manifest; equal manifests give equal bytes."""
    lines = [_line(_row_fields(row)) for row in manifest.rows]
    header = {
        "format": FORMAT, "recipes": manifest.recipes_sha, "division": asdict(manifest.division), "clips": len(lines),
        "clips_sha256": _sha(lines), "prevalence": manifest.prevalence,
    }
    return "".join([_line(header), *lines]).encode()


def from_bytes(data: bytes) -> Manifest:
    """Read and verify a manifest. Raises ManifestError: damaged, of another format, with false counts, or see check."""
    try:
        first, *lines = (line.decode() for line in io.BytesIO(data))
        header = json.loads(first)
        if header.get("format") != FORMAT:
            raise ManifestError(f"the manifest has format {header.get('format')!r}, not {FORMAT!r}; build it again")
        if (len(lines), _sha(lines)) != (header["clips"], header["clips_sha256"]):
            raise ManifestError(f"the manifest is damaged: {len(lines)} clips of another hash than it says; restore it")
        stated: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in header["division"].items()}
        manifest = Manifest(Division(**stated), tuple(_read_row(json.loads(line)) for line in lines), header["recipes"])
        counted = header["prevalence"]
    except ManifestError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ManifestError(f"the manifest cannot be read: {type(error).__name__}: {error}; restore it") from error
    check(manifest)
    if counted != manifest.prevalence:
        raise ManifestError("the manifest counts other labels than its clips have; build the set again")
    return manifest


def regenerate(row: ManifestRow, root: LabelledClip, redraw: Redraw | None) -> LabelledClip:
    """Make a row's clip from its recorded clip and verify it. Raises ManifestError: other pixels, amounts or labels."""
    clip = replay(root, row.edits, redraw)
    description = (root.sha256, clip.sha256, clip.edits, clip.labels)
    if description != (row.root, row.sha256, row.edits, row.labels):
        raise ManifestError(
            f"clip {row.sha256[:12]} ({_chain(row)}) came out as {clip.sha256[:12]}: another renderer or recorded clip"
        )
    return clip


def _part_and_split(origin: Origin, edits: Sequence[Edit], labels: ClipTruth, division: Division) -> tuple[Part, Split]:
    hacked = any(edit.severity == "fail" and get_recipe(edit.recipe).pattern for edit in edits)
    if hacked != (labels.pattern is not None):
        raise ManifestError(f"label {labels.pattern!r} does not fit the recipes {[edit.recipe for edit in edits]}")
    return division.part(origin), division.held_out(origin) or ("hack" if hacked else "iid")


def _row(clip: LabelledClip, division: Division) -> ManifestRow:
    origin = clip.clip.origin
    part, split = _part_and_split(origin, clip.edits, clip.labels, division)
    return ManifestRow(clip.sha256, clip.root, origin, clip.edits, clip.labels, part, split)


def _row_fields(row: ManifestRow) -> dict[str, Any]:
    components = row.labels.components
    return {
        "sha256": row.sha256, "root": row.root, "origin": asdict(row.origin), "part": row.part, "split": row.split,
        "edits": [asdict(edit) for edit in row.edits],
        "fails": [name for name in COMPONENTS if components.get(name) is False],
        "unknown": [name for name in COMPONENTS if name not in components],
        "tc_level": row.labels.tc_level, "pattern": row.labels.pattern,
    }


def _read_row(values: dict[str, Any]) -> ManifestRow:
    unknown, fails = values.pop("unknown"), values.pop("fails")
    if foreign := sorted({*unknown, *fails} - set(COMPONENTS)):
        raise ValueError(f"unknown components {foreign}")
    components = {name: name not in fails for name in COMPONENTS if name not in unknown}
    labels = ClipTruth(components, values.pop("tc_level"), values.pop("pattern"))
    edits = tuple(Edit(**edit) for edit in values.pop("edits"))
    return ManifestRow(origin=Origin(**values.pop("origin")), edits=edits, labels=labels, **values)


def _chain(row: ManifestRow) -> str:
    return " then ".join(f"{edit.recipe} ({edit.severity})" for edit in row.edits) or "recording"


def _line(values: dict[str, Any]) -> str:
    return json.dumps(values, sort_keys=True, allow_nan=False) + "\n"


def _sha(lines: Sequence[str]) -> str:
    return hashlib.sha256("".join(lines).encode()).hexdigest()
