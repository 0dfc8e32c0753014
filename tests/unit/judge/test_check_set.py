"""The shipped clips that judges are checked on."""

import json
import shutil
from collections import Counter
from pathlib import Path

import pytest

from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import Stage
from wm_nodes.judge.check_set import CHECK_SET, ClipTruth, load_check_set
from wm_nodes.judge.decisions import row_names


@pytest.fixture(scope="module")
def truths() -> list[ClipTruth]:
    return [clip.truth for clip in load_check_set()]


def test_half_the_shipped_clips_are_spoiled_and_the_whole_is_small(truths: list[ClipTruth]) -> None:
    families = Counter((truth.part, truth.is_fault) for truth in truths)
    assert 100 <= len(truths) <= 150
    assert families["near", True] == families["near", False] >= 30
    assert families["policy", True] == families["policy", False] >= 30
    assert {truth.family for truth in truths} == {"clean", "benign", "pixels", "time", "state"}
    patterns = {pattern for truth in truths for pattern in truth.patterns}
    assert patterns == {"occlusion", "motion", "background", "physics"}
    assert sum(path.stat().st_size for path in CHECK_SET.rglob("*") if path.is_file()) < 5_000_000


def test_a_clip_is_a_success_exactly_where_the_task_is_done_and_nothing_fails(truths: list[ClipTruth]) -> None:
    for truth in truths:
        nothing_fails = all(truth.components.values())
        assert truth.success == (nothing_fails and truth.completion == 4), truth
        assert not (truth.is_fault and truth.success), truth
    assert sum(truth.success for truth in truths) >= 40
    assert any(truth.family == "clean" and not truth.success for truth in truths)
    assert sum(truth.completion == 4 for truth in truths if truth.is_fault) > 30


def test_every_recording_is_there_beside_its_edits_and_both_name_one_task() -> None:
    clips = load_check_set()
    by_name = {clip.truth.clip_id: clip for clip in clips}
    edited = Counter(clip.truth.parent for clip in clips if clip.truth.edits)
    for clip in clips:
        parent = by_name[clip.truth.parent]
        assert parent.truth.family == "clean" and edited[clip.truth.parent] > 0
        assert clip.job.task.instruction == parent.job.task.instruction
        assert (clip.job.task.reference_frame == parent.job.clip.frames[0]).all()


def test_near_clips_are_square_and_policy_clips_show_both_cameras() -> None:
    shapes = {(clip.truth.part, clip.job.clip.frames.shape[1:]) for clip in load_check_set()}
    assert shapes == {("near", (96, 96, 3)), ("policy", (64, 128, 3))}
    assert min(len(clip.job.clip.frames) for clip in load_check_set()) >= 8


def test_every_row_of_the_table_has_passing_and_failing_clips(truths: list[ClipTruth]) -> None:
    rubric = load_rubric("robot")
    rows = [truth.rows(rubric) for truth in truths]
    for name in row_names(rubric):
        assert len({row[name] for row in rows} - {None}) >= 2, name


def test_a_rubric_without_a_stage_has_no_row_of_it(truths: list[ClipTruth]) -> None:
    rubric = load_rubric("robot")
    without = rubric.model_copy(update={"stages": {s: of for s, of in rubric.stages.items() if s is not Stage.TC}})
    completion = {*rubric.stages[Stage.TC].components}
    assert truths[0].rows(rubric).keys() - truths[0].rows(without).keys() >= completion
    assert row_names(without) == [name for name in row_names(rubric) if name not in completion]


def test_a_changed_picture_is_refused_by_name(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    shutil.copytree(CHECK_SET, folder)
    victim = sorted((folder / "clips").iterdir())[3]
    victim.write_bytes(victim.read_bytes() + b"\0")
    with pytest.raises(ValueError, match=rf"{folder}.*clips/{victim.name} is not the file.*install wm_nodes again"):
        load_check_set(folder)


def test_a_missing_file_and_another_format_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"cannot be used: .*manifest\.json"):
        load_check_set(tmp_path)
    (tmp_path / "manifest.json").write_text(json.dumps({"format": "other"}))
    with pytest.raises(ValueError, match="its format is 'other', not 'judge-check-1'"):
        load_check_set(tmp_path)
