"""Normal ranges: fitted on recordings, kept in a file, refused where they cannot be used."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.one_class import imagination, pictures
from wm_nodes.judge.one_class.ranges import (
    COMPONENTS,
    LEAST,
    NAMES,
    PIXELS,
    NormalRanges,
    done_threshold,
    file_of,
    fit,
    has_ranges,
    load_ranges,
    save_ranges,
    strides_of,
)


def made(recordings: int = 2 * LEAST, seed: int = 0) -> NormalRanges:
    """Ranges of normally distributed numbers, two clips per recording."""
    values = np.random.default_rng(seed).normal(size=(2 * recordings, len(NAMES)))
    rows = [dict(zip(NAMES, row.tolist())) for row in values]
    return NormalRanges(
        world_model="0" * 64, stride=1, lengths=(3, 34), still=(True, False), origin=(0.1, 0.2, 0.3), height_m=0.02,
        done={"push_cube": 0.2}, words=("blue cube", "red target"), story={"recordings": recordings},
        **fit(rows, [i // 2 for i in range(len(rows))], seed),
    )


def test_every_number_speaks_about_one_component_and_every_component_has_one() -> None:
    assert not set(pictures.COMPONENTS) & set(imagination.COMPONENTS) and set(PIXELS) <= set(NAMES) == set(COMPONENTS)
    gates = load_rubric("robot").component_names
    assert set(COMPONENTS.values()) == set(gates) - {"task_completion"}


def test_the_file_gives_the_ranges_back(tmp_path: Path) -> None:
    ranges = made()
    assert not has_ranges(tmp_path)
    save_ranges(tmp_path, ranges)
    save_ranges(tmp_path, replace(ranges, stride=5))
    assert load_ranges(tmp_path, 1) == ranges and load_ranges(tmp_path, 1).sha256 == ranges.sha256
    assert has_ranges(tmp_path) and strides_of(tmp_path) == [1, 5]


def test_the_identity_is_of_what_decides_an_answer() -> None:
    ranges = made()
    assert replace(ranges, story={"made": "later"}).sha256 == ranges.sha256
    assert replace(ranges, done={"push_cube": 0.3}).sha256 != ranges.sha256


def test_a_number_lies_where_it_is_seen_and_goes_as_far_as_nearly_all_recordings() -> None:
    ranges = made()
    assert all(abs(ranges.middle[name]) < 0.4 and 2 < ranges.spread[name] < 5 for name in NAMES)
    assert len(ranges.scores) == 2 * LEAST and list(ranges.scores) == sorted(ranges.scores)
    strange = ranges.strangeness({name: ranges.middle[name] + 2 * ranges.spread[name] for name in NAMES})
    assert strange == pytest.approx(dict.fromkeys(NAMES, 2.0))


def test_a_recording_is_scored_by_the_ranges_of_others() -> None:
    rows = [dict.fromkeys(NAMES, 0.0) for _ in range(LEAST)]
    rows[7]["tool_step_m"] = 1.0
    fitted = fit(rows, range(LEAST), 0)
    assert fitted["scores"][-1] == pytest.approx(100), "the others go no further than the least spread, 0.01 m"
    assert fitted["scores"][-2] == 0


def test_numbers_that_never_change_have_a_least_spread_in_their_unit() -> None:
    rows = [dict.fromkeys(NAMES, 0.0)] * LEAST
    spread = fit(rows, range(LEAST), 0)["spread"]
    assert (spread["tool_step_m"], spread["stranger"], spread["tint"]) == (0.01, 1.0, 0.05)


def test_the_limit_rises_with_the_share_that_is_kept() -> None:
    ranges = made()
    limits = [ranges.limit(kept) for kept in (0.0, 0.001, 0.25, 0.5, 0.9, 0.97, 1.0)]
    assert limits == sorted(limits) and (limits[0], limits[-1]) == (ranges.scores[0], ranges.scores[-1])
    kept = np.mean([score <= ranges.limit(0.9) for score in ranges.scores])
    assert kept == pytest.approx(0.9, abs=0.02)


def test_too_few_recordings_are_refused_however_many_clips() -> None:
    with pytest.raises(ValueError, match=f"at least {LEAST} recordings, got {LEAST - 1}; name more bags"):
        made(LEAST - 1)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"format": "normal-ranges-0"}, "another version"),
        ({"middle": {}}, "another version"),
        ({"spread": {}}, "another version"),
        ({"spread": dict.fromkeys(NAMES, 0.0)}, "damaged"),
        ({"middle": dict.fromkeys(NAMES, float("nan"))}, "damaged"),
        ({"scores": []}, "damaged"),
        ({"scores": [2.0, 1.0]}, "damaged"),
        ({"stride": 2}, "damaged"),
        ({"height_m": float("nan")}, "damaged"),
        ({"scores": None}, "cannot be used"),
        ({"more": 1}, "unexpected keyword"),
    ],
)
def test_damaged_ranges_are_refused_in_one_line_with_the_command(
    tmp_path: Path, change: dict[str, object], problem: str
) -> None:
    path = save_ranges(tmp_path, made())
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ModelFolderError, match=problem) as refused:
        load_ranges(tmp_path, 1)
    assert f"wm judge calibrate {tmp_path} BAG --stride 1" in str(refused.value) and "\n" not in str(refused.value)


def test_a_missing_file_and_one_that_is_cut_off_are_refused_likewise(tmp_path: Path) -> None:
    with pytest.raises(ModelFolderError, match=r"is missing; make it: wm judge calibrate .* --stride 3"):
        load_ranges(tmp_path, 3)
    path = save_ranges(tmp_path, made())
    path.write_text(path.read_text()[:500])
    with pytest.raises(ModelFolderError, match=r"cannot be read .*wm judge calibrate"):
        load_ranges(tmp_path, 1)
    assert file_of(tmp_path, 1) == path


def test_the_done_threshold_is_reached_by_few_undone_recordings_and_is_bounded() -> None:
    signals = np.linspace(0.0, 0.99, 200)
    threshold = done_threshold([*signals, 0.9], [*[False] * 200, True])
    assert 0.05 < (signals > threshold).mean() < 0.11
    assert done_threshold([0.2, 0.3], [True, True]) == 0.5, "no undone recording says anything"
    assert (done_threshold([0.0, 0.9], [False, True]), done_threshold([1.0], [False])) == (0.05, 0.95)
