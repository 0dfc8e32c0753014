"""What a benchmark set consists of: splits, prevalence, hashes. RA-21."""

import functools
import hashlib
import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import pytest
from pushed_box import push_clip, redrawn

from wm_nodes.judge.dataset.edits.clips import COMPONENTS, TC, LabelledClip, Origin
from wm_nodes.judge.dataset.edits.generator import children
from wm_nodes.judge.dataset.edits.manifest import (
    SPLITS,
    Division,
    Manifest,
    ManifestError,
    from_bytes,
    manifest_of,
    regenerate,
    to_bytes,
)
from wm_nodes.judge.dataset.edits.recipes import RECIPES, apply

DIVISION = Division(cameras=("top",), scenes=("marble",), objects=("mug/red",), validation=0.2, test=0.3)
NAMES = ("blur", "freeze", "ghost_motion", "occlude_patch", "flatten", "object_vanish")


@functools.cache
def roots() -> tuple[LabelledClip, ...]:
    places = [{}, {"camera": "top"}, {"scene": "marble"}, {"object_id": "mug/red"}]
    return tuple(push_clip("expert", seed, **place) for seed, place in enumerate(places))


@functools.cache
def manifest() -> Manifest:
    clips = [clip for root in roots() for clip in (root, *children(root, 0, redrawn, names=NAMES))]
    return manifest_of([*clips, *clips[:3]], DIVISION)


def test_every_clip_is_there_once_and_goes_where_its_origin_says() -> None:
    rows = manifest().rows
    assert len(rows) == len({row.sha256 for row in rows}) == 4 * (1 + 2 * len(NAMES))
    assert {row.split for row in rows} == {"iid", "hack", "new_camera", "new_scene", "new_object"}
    for row in rows:
        failing = row.edits and row.edits[-1].severity == "fail"
        if row.origin.camera == "top":
            assert row.split == "new_camera" and row.part == "test"
        elif row.origin.seed == 0:
            hacking = failing and RECIPES[row.edits[-1].recipe].pattern
            assert row.split == ("hack" if hacking else "iid")
    hacks = [row for row in rows if row.split == "hack"]
    patterns = ["background", "motion", "occlusion", "physics"]
    assert sorted(str(row.labels.pattern) for row in hacks) == patterns
    clean = {row.sha256: row for row in rows if not row.edits}
    assert all(clean[row.root].labels.overall for row in hacks)


def test_parts_have_about_their_shares_and_an_episode_is_in_one_of_them() -> None:
    origins = [Origin("push_cube", "front", "cube/blue", "gravel", seed) for seed in range(2000)]
    parts = [DIVISION.part(origin) for origin in origins]
    assert Counter(parts)["test"] == pytest.approx(600, abs=60)
    assert Counter(parts)["validation"] == pytest.approx(400, abs=60)
    assert [DIVISION.part(replace(origin, camera="left", behaviour="short")) for origin in origins] == parts
    assert {DIVISION.part(replace(origin, camera="top")) for origin in origins[:50]} == {"test"}


def test_prevalence_adds_up() -> None:
    counts, rows = manifest().prevalence, manifest().rows
    for component in (*COMPONENTS, TC, "overall"):
        assert sum(counts["all"][component].values()) == len(rows)
        for kind in ("pass", "fail", "unknown"):
            assert sum(counts[split][component][kind] for split in SPLITS) == counts["all"][component][kind]
    # worked by hand: 4 clips each; blur and the hidden defect fail clarity, a vanished object leaves physics unknown
    assert counts["all"]["clarity"] == {"pass": 44, "fail": 8, "unknown": 0}
    assert counts["all"]["background"]["fail"] == counts["all"]["objective"]["fail"] == 4
    assert counts["all"]["deformation"]["unknown"] == 4 and counts["all"]["temporal"]["unknown"] == 4
    assert counts["all"]["overall"] == {"pass": 28, "fail": 24, "unknown": 0}


def test_a_manifest_survives_its_file_and_equal_sets_give_equal_bytes() -> None:
    data = to_bytes(manifest())
    assert from_bytes(data) == manifest()
    assert to_bytes(manifest_of([clip for root in reversed(roots()) for clip in (
        *children(root, 0, redrawn, names=NAMES), root)], DIVISION)) == data
    assert len(data) < 1000 * (len(manifest().rows) + 4)


def test_every_clip_can_be_made_again_from_its_row() -> None:
    by_sha = {root.sha256: root for root in roots()}
    for row in manifest().rows:
        if row.origin.seed == 0:
            assert regenerate(row, by_sha[row.root], redrawn).sha256 == row.sha256
    other = next(row for row in manifest().rows if row.origin.seed == 0 and row.edits)
    with pytest.raises(ManifestError, match="another renderer or recorded clip"):
        regenerate(other, roots()[1], redrawn)


def without_root(lines: list[str]) -> list[str]:
    return [line for line in lines if json.loads(line)["edits"] or json.loads(line)["origin"]["seed"] != 2]


def failing_recording(lines: list[str]) -> list[str]:
    rows = [json.loads(line) for line in lines]
    changed = [row if row["edits"] else row | {"fails": ["interaction"]} for row in rows]
    return [json.dumps(row, sort_keys=True) + "\n" for row in changed]


def first_row(change: Callable[[dict[str, object]], object]) -> Callable[[list[str]], list[str]]:
    def changed(lines: list[str]) -> list[str]:
        row = json.loads(lines[0])
        change(row)
        return [json.dumps(row, sort_keys=True) + "\n", *lines[1:]]

    return changed


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda lines: lines[:-1], "the manifest is damaged: 51 clips"),
        (first_row(lambda row: row.update(tc_level=0)), "the manifest is damaged: 52 clips"),
    ],
)
def test_a_damaged_file_is_refused(change: Callable[[list[str]], list[str]], complaint: str) -> None:
    header, *lines = to_bytes(manifest()).decode().splitlines(keepends=True)
    with pytest.raises(ManifestError, match=complaint):
        from_bytes("".join([header, *change(lines)]).encode())


def rewritten(change: Callable[[list[str]], list[str]], **header: object) -> bytes:
    """A file whose hash is right again, as a careless hand leaves it."""
    first, *lines = to_bytes(manifest()).decode().splitlines(keepends=True)
    lines = change(lines)
    sha = hashlib.sha256("".join(lines).encode()).hexdigest()
    fields = json.loads(first) | {"clips": len(lines), "clips_sha256": sha} | header
    return "".join([json.dumps(fields, sort_keys=True) + "\n", *lines]).encode()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (without_root, "lacks its recorded clip .*; add that, unedited"),
        (lambda lines: [*lines, lines[0]], "one is there twice"),
        (first_row(lambda row: row.update(part="elsewhere")), "is not of elsewhere"),
        (failing_recording, r"recording \w{12} fails what the simulator made"),
        (first_row(lambda row: row.update(fails=["smell"])), r"unknown components \['smell'\]"),
        (first_row(lambda row: row.pop("root")), "cannot be read: TypeError"),
        (first_row(lambda row: row.update(tc_level=(row["tc_level"] + 4) % 8 % 5)), "counts other labels"),
    ],
)
def test_an_inconsistent_file_is_refused(change: Callable[[list[str]], list[str]], complaint: str) -> None:
    with pytest.raises(ManifestError, match=complaint):
        from_bytes(rewritten(change))


def test_other_recipes_and_formats_are_refused() -> None:
    with pytest.raises(ManifestError, match=r"these are .*: build the set again, or take the version"):
        from_bytes(rewritten(list, recipes="0" * 64))
    with pytest.raises(ManifestError, match="format 'later'"):
        from_bytes(rewritten(list, format="later"))
    with pytest.raises(ManifestError, match="cannot be read"):
        from_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match=r"validation 0\.6 and test 0\.7"):
        Division(validation=0.6, test=0.7)


def test_one_picture_cannot_have_two_labels() -> None:
    root = roots()[0]
    blurred = apply(root, "blur", "fail", 0)
    relabelled = replace(blurred, labels=root.labels)
    with pytest.raises(ManifestError, match=r"by blur \(fail\) and by blur \(fail\); drop both"):
        manifest_of([root, blurred, relabelled], DIVISION)
