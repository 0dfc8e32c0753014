"""The benchmark of a judge that errs: its errors are what they are said to be, and what votes can and cannot mend."""

import asyncio
import json
from pathlib import Path

import numpy as np
import pytest
from scripted_judge import make_clip, make_task

from benchmarks.judge import erring
from benchmarks.judge.erring import AGENT, MEASURES, PACKS, Judged, judge_clips, labels_of, measured
from benchmarks.judge.label_judge import ClipLabels, Errors, LabelJudge
from wm_nodes.apps.cli import main
from wm_nodes.judge.agent.judge import Read, ReadRequest, Vote
from wm_nodes.judge.agent.levels import first_vote, next_vote, p_fail_of
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import PLANNING, Profile, Stage
from wm_nodes.judge.check_set import LabelledClip, load_check_set

RUBRIC = load_rubric()
PASSED = {name: index % 2 == 0 for index, name in enumerate(RUBRIC.component_names)}
NUM_CLIPS = 300


@pytest.fixture(scope="module")
def clips() -> list[LabelledClip]:
    return load_check_set()


def judged(clips: list[LabelledClip], way: str, errors: Errors, seed: int = 0) -> list[Judged]:
    rubric = load_rubric(PACKS[way])
    return asyncio.run(judge_clips(clips, LabelJudge(labels_of(clips), RUBRIC, errors, seed=seed), rubric, seed))


def reads_of(errors: Errors, *votes: Vote, stage: Stage = Stage.VQ, names: tuple[str, ...] = ()) -> list[list[Read]]:
    """Of each of NUM_CLIPS clips with equal labels, and of each component, one read per vote."""
    frames = [make_clip(seed, 2) for seed in range(NUM_CLIPS)]
    labels = ClipLabels(PASSED, 2, 3, frozenset({"motion"}))
    judge = LabelJudge({clip.sha256: labels for clip in frames}, RUBRIC, errors)
    asked = names or tuple(RUBRIC.component_names[:11])
    reads = []
    for clip in frames:
        request = ReadRequest(clip, make_task(clip), stage, asked, Profile.S, votes, ())
        found = asyncio.run(judge.read(request))
        reads += [found[start : start + len(votes)] for start in range(0, len(found), len(votes))]
    return reads


def is_wrong(read: Read) -> bool:
    return (p_fail_of(read.levels) < 0.5) != PASSED[read.component]


@pytest.mark.parametrize("honest", [True, False])
@pytest.mark.parametrize(("rate", "shared"), [(0.05, 0.0), (0.2, 0.0), (0.1, 0.5), (0.2, 1.0)])
def test_reads_err_at_their_rate_and_two_of_them_together_as_often_as_their_correlation_says(
    rate: float, shared: float, honest: bool
) -> None:
    pairs = reads_of(Errors(rate, shared, honest), first_vote(0), next_vote(1, 0))
    wrong = np.array([[is_wrong(read) for read in pair] for pair in pairs])
    assert wrong.mean() == pytest.approx(rate, abs=0.02)
    assert np.corrcoef(wrong.T)[0, 1] == pytest.approx(shared, abs=0.08)


def test_an_honest_read_is_as_sure_as_it_is_often_right_and_an_overconfident_one_always() -> None:
    reads = [read for (read,) in reads_of(Errors(0.2, 0.0, honest=True), first_vote(0))]
    doubt = np.array([min(p, 1 - p) for p in (p_fail_of(read.levels) for read in reads)])
    wrong = np.array([is_wrong(read) for read in reads])
    for low, high in ((0.0, 0.1), (0.1, 0.3), (0.3, 0.5)):
        some = (doubt >= low) & (doubt <= high)
        assert wrong[some].mean() == pytest.approx(doubt[some].mean(), abs=0.05)
    assert {max(read.levels) for (read,) in reads_of(Errors(0.2), first_vote(0))} == {1.0}


def test_a_wrong_level_is_one_or_two_off_and_a_wrong_pattern_is_turned_round() -> None:
    levels: dict[str, set[int]] = {PLANNING: set(), "task_completion": set()}
    for (read,) in reads_of(Errors(0.5), first_vote(0), names=(PLANNING, "task_completion")):
        levels[read.component].add(read.levels.index(1.0))
    assert levels == {PLANNING: {0, 1, 2, 3}, "task_completion": {1, 2, 3, 4}}
    flags = reads_of(Errors(0.2), first_vote(0), stage=Stage.HACK, names=("motion", "physics", "background"))
    present = np.array([read.levels[0] == 1.0 for (read,) in flags]).reshape(NUM_CLIPS, 3)
    assert present.mean(0) == pytest.approx([0.8, 0.2, 0.2], abs=0.07)


def test_errors_that_cannot_be_are_refused_and_an_unknown_clip_is_named() -> None:
    for wrong in ({"rate": 0.6}, {"rate": -0.1}, {"shared": 1.5}):
        with pytest.raises(ValueError, match=r"rate must lie in \[0, 0.5\] and shared in \[0, 1\]"):
            Errors(**wrong)
    clip = make_clip()
    request = ReadRequest(clip, make_task(clip), Stage.VQ, ("clarity",), Profile.S, (first_vote(0),), ())
    with pytest.raises(ValueError, match="clip clip0 has no labels"):
        asyncio.run(LabelJudge({}, RUBRIC).read(request))


@pytest.mark.parametrize("way", list(PACKS))
def test_without_errors_every_way_is_right_on_every_clip_of_the_shipped_set(
    clips: list[LabelledClip], way: str
) -> None:
    found = measured(clips, judged(clips, way, Errors()), RUBRIC)
    assert (found["accuracy"], found["components"], found["successes_kept"]) == (1, 1, 1)
    assert found["faults_accepted"] == found["silent"] == 0


@pytest.mark.parametrize("honest", [True, False])
def test_where_all_reads_repeat_one_answer_votes_and_second_looks_change_nothing_but_the_cost(
    clips: list[LabelledClip], honest: bool
) -> None:
    errors = Errors(0.2, 1.0, honest)
    single, voted, agent = (judged(clips, way, errors) for way in ("neither", "all voted", AGENT))
    assert [one.accepted for one in single] == [one.accepted for one in voted] == [one.accepted for one in agent]
    assert [one.passed for one in single] == [one.passed for one in voted]
    assert sum(one.calls for one in single) < sum(one.calls for one in agent) < sum(one.calls for one in voted)


def test_independent_errors_are_mended_by_votes(clips: list[LabelledClip]) -> None:
    for seed in range(2):
        single, voted = (
            measured(clips, judged(clips, way, Errors(0.1), seed), RUBRIC) for way in ("neither", "all voted")
        )
        assert voted["components"] > single["components"] and voted["accuracy"] > single["accuracy"] + 0.05


def test_measures_are_counted_as_worked_by_hand(clips: list[LabelledClip]) -> None:
    """Three successes: kept, refused, without a verdict; two faults: one accepted."""
    good, bad = ([c for c in clips if test(c)] for test in (lambda c: c.truth.success, lambda c: c.truth.is_fault))
    accepted = (True, False, None, True, False)
    found = [Judged(said, {"clarity": True}, frozenset(), 4, 10 * index) for index, said in enumerate(accepted)]
    blurred = [clip for clip in bad if clip.truth.components["clarity"] is False]
    counted = measured([*good[:3], *blurred[:2]], found, RUBRIC)
    assert counted == {
        "accuracy": 2 / 5, "components": 0.5, "faults_accepted": 1 / 2, "successes_kept": 1 / 3, "silent": 1 / 5,
        "calls": 4, "images": 20,
    }


def test_the_command_prints_and_writes_every_way_against_the_agent(
    clips: list[LabelledClip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(erring, "load_check_set", lambda folder: clips[:6])
    monkeypatch.setattr(erring, "RATES", (0.1,))
    target = tmp_path / "erring.json"
    assert main(["benchmark", "erring", "--seeds", "2", "--json", str(target)]) == 0
    shown, found = capsys.readouterr().out, json.loads(target.read_text())
    assert "10% of reads err, correlation 0.5, overconfident" in shown and "per audited clip" in shown
    assert found["command"] == f"wm benchmark erring --seeds 2 --json {target}"
    assert len(found["ways"]) == 6 * len(PACKS) and len(found["audits"]) == 12
    assert found["audit_shares"] == {"votes": 0.05, "looks": 0.05}
    for row in found["ways"]:
        assert all(row[name][1] <= row[name][0] <= row[name][2] for name in ("accuracy", "calls"))
        assert set(row["difference"]) == (set() if row["way"] == AGENT else set(MEASURES))


def test_a_folder_without_a_set_is_one_clear_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "erring", "--check-set", str(tmp_path)]) == 2
    assert "cannot be used" in capsys.readouterr().err
