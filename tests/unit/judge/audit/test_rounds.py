"""Sampling, people as the judge and agreement: a round of the paper's loop, with numbers worked by hand."""

import asyncio
import json
import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_logs import Job, JudgeByClip, clips, judge_all
from scripted_judge import CLEAN, FLAWED, WRONG, FaultyJudge, ScriptedJudge, clean_table

from wm_nodes.apps.cli import main
from wm_nodes.core.statistics import wilson_interval
from wm_nodes.judge.agent.judge import Read, ReadRequest
from wm_nodes.judge.agent.levels import next_vote
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.rubric import Rubric, load_rubric
from wm_nodes.judge.agent.types import Profile, Stage, Status, TaskSpec
from wm_nodes.judge.audit.agreement import AgreementRow, join_labels, report
from wm_nodes.judge.audit.labels import FORMAT, read_labels
from wm_nodes.judge.audit.log import AuditError
from wm_nodes.judge.audit.people import HumanJudge
from wm_nodes.judge.audit.reading import RecordedEvaluation, read_record
from wm_nodes.judge.audit.sampling import SHARES, draw, draw_stratified, read_sample, sample_size, stratum_of

RUBRIC = load_rubric()
TIED = [(0.0, 0.4, 0.0, 0.0, 0.6), WRONG] * 2 + [(0.0, 0.4, 0.0, 0.0, 0.6)]
"""Five votes, three pass and the pooled levels fail: ABSTAIN."""
Tables = list[dict[str, Any]]


def judged(folder: Path, tables: Tables, rubric: Rubric = RUBRIC, **settings: Any) -> list[RecordedEvaluation]:
    """Clip i is judged by table i, everything else clean; benchmark mode."""
    jobs = clips(len(tables))
    judges = {clip.clip_id: ScriptedJudge(clean_table(rubric, **table)) for (clip, _), table in zip(jobs, tables)}
    judge_all(folder, JudgeByClip(judges), jobs, rubric=rubric, mode="benchmark", **settings)
    return read_record(folder).judged()


def write_labels(
    path: Path, evaluations: list[RecordedEvaluation], rows: list[Mapping[str, Any]], who: str = "Ada"
) -> Path:
    """AgreementRow values: True, False, None (unsure), a planning level, or (answer, explanation)."""

    def row(name: str, value: Any) -> dict[str, Any]:
        answer, reason = value if isinstance(value, tuple) else (value, None)
        if name == "planning" and answer is not None:
            return {"answer": "pass" if answer >= 2 else "fail", "level": answer, "explanation": reason}
        word = {True: "pass", False: "fail", None: "unsure"}[answer]
        return {"answer": word, "level": None, "explanation": reason}

    labels = [
        {"evaluation": e.number, "sha256": e.sha256, "audit_id": e.verdict.audit_id,
         "rows": {name: row(name, value) for name, value in said.items()}}
        for e, said in zip(evaluations, rows) if said
    ]
    content = {"format": FORMAT, "head": "", "annotator": who, "exported": "2026-11-21T21:00:00Z", "labels": labels}
    path.write_text(json.dumps(content))
    return path


# --- sampling ---------------------------------------------------------------------------------------------------
def test_the_size_of_a_sample_follows_the_paper() -> None:
    assert sample_size(1.0, 5000) == 200
    assert sample_size(0.5, 5000) == 400
    assert sample_size(0.0, 5000) == 600
    assert sample_size(0.0, 256) == 256


def test_weights_are_the_inverse_of_how_often_a_clip_is_drawn() -> None:
    strata = ["conflict"] * 3 + ["reflection"] * 40 + ["near_gate"] * 10 + ["random"] * 47
    rng = np.random.default_rng(0)
    times, totals = np.zeros(100), []
    for _ in range(3000):
        drawn, weights, sizes = draw_stratified(strata, 40, rng)
        assert len(set(drawn)) == 40
        times[drawn] += 1
        totals.append(sum(weights.values()))
    assert sizes == {"conflict": 3, "reflection": 40, "near_gate": 10, "top_reward": 0, "random": 47}
    # quotas of 40: conflict min(4, 3) = 3, reflection 6, near_gate 8, top_reward min(6, 0) = 0; 23 of the 83 left
    chance = {"conflict": 1.0, "reflection": 6 / 40 + 34 / 40 * 23 / 83, "near_gate": 0.8 + 0.2 * 23 / 83,
              "random": 23 / 83}
    assert {strata[i]: 1 / weights[i] for i in drawn} == pytest.approx(chance)
    for name, expected in chance.items():
        members = np.array([stratum == name for stratum in strata])
        assert times[members].mean() / 3000 == pytest.approx(expected, abs=0.01)
    assert np.mean(totals) == pytest.approx(100, rel=0.01)  # the weights of a sample stand for the whole round


def test_a_clip_is_put_where_a_person_learns_most(tmp_path: Path) -> None:
    tables: Tables = [{}, {}, {"task_completion": WRONG}, {"clarity": TIED}, {"clarity": [CLEAN, CLEAN, WRONG]}]
    jobs = clips(5)
    judges = {clip.clip_id: ScriptedJudge(clean_table(RUBRIC, **table)) for (clip, _), table in zip(jobs, tables)}
    judges["clip4"].second = {"clarity": WRONG}
    evidence = {"clip1": {"temporal": 9.0}}
    always = {"audit_share": 1.0}
    rubric = load_rubric("robot", {"voting": always, "reflection": always})
    judge_all(tmp_path, JudgeByClip(judges), jobs, rubric=rubric, evidence=evidence, mode="benchmark")
    strata = {e.clip_id: stratum_of(e, rubric) for e in read_record(tmp_path).judged()}
    assert strata == {
        "clip0": "random",
        "clip1": "conflict",  # the evidence contradicts a pass
        "clip2": "near_gate",  # S = 0.25 against a threshold of 0.30
        "clip3": "conflict",  # votes that contradict each other: ABSTAIN
        "clip4": "reflection",  # the second look changed a component
    }


def test_equal_verdicts_and_seeds_choose_equal_clips(tmp_path: Path) -> None:
    tables: Tables = [{"clarity": WRONG} if i % 3 else {} for i in range(30)]
    judged(tmp_path / "a", tables, seed=1)
    jobs = clips(30)[::-1]
    judges = {f"clip{i}": ScriptedJudge(clean_table(RUBRIC, **table)) for i, table in enumerate(tables)}
    judge_all(tmp_path / "b", JudgeByClip(judges), jobs, rubric=RUBRIC, mode="benchmark", seed=1)
    first, second = (draw(read_record(tmp_path / name), 0, seed=5, size=10) for name in ("a", "b"))
    assert [one.audit_id for one in first.chosen] == [one.audit_id for one in second.chosen]
    assert sum(one.second for one in first.chosen) == 2
    other = draw(read_record(tmp_path / "a"), 0, seed=6, size=10)
    assert [one.audit_id for one in other.chosen] != [one.audit_id for one in first.chosen]
    assert sum(one.stratum == "top_reward" for one in draw(read_record(tmp_path / "a"), 0, size=30).chosen) > 0
    with pytest.raises(AuditError, match=r"no verdict of round 3; rounds: \[0\]"):
        draw(read_record(tmp_path / "a"), 3)
    assert sum(SHARES.values()) == pytest.approx(0.6)


def test_a_round_without_a_reward_has_no_mean_of_0(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    judge_all(tmp_path, FaultyJudge(clean_table(RUBRIC), "robot", "unavailable"), clips(2))
    assert main(["audit", "sample", str(tmp_path)]) == 0
    assert "2 of 2 clips of round 0, no reward: " in capsys.readouterr().out
    assert read_sample(tmp_path / "sample-0.json").mean_reward is None


# --- people as the judge ------------------------------------------------------------------------------------------
def everything(**changed: Any) -> dict[str, Any]:
    """What a person says who finds nothing wrong but what is named; a level where it is a number."""
    names = [*RUBRIC.component_names, *(f"hack: {name}" for name in RUBRIC.hack.patterns)]
    return dict.fromkeys(names, True) | {"planning": 3} | changed


def test_people_are_a_judge_that_everybody_who_is_sure_votes_in(tmp_path: Path) -> None:
    evaluations = judged(tmp_path / "log", [{}, {}])
    said = [write_labels(tmp_path / f"{who}.json", evaluations, rows, who) for who, rows in (
        ("Ada", [everything(clarity=False), everything(clarity=None, color=False)]),
        ("Bob", [everything(planning=2), everything()]),
        ("Cleo", [everything(clarity=False), everything(clarity=True, color=None)]),
    )]
    judge = HumanJudge([read_labels(path) for path in said], read_record(tmp_path / "log"))
    first, second = clips(2)
    assert judge.capabilities.judge_id.startswith("human:") and "Ada, Bob, Cleo" in judge.capabilities.card

    def read(job: Job, stage: Stage, name: str) -> Read:
        reads = asyncio.run(judge.read(ReadRequest(*job, stage, (name,), Profile.S, (next_vote(1, 0),), ())))
        return reads[0]

    assert read(first, Stage.VQ, "clarity").levels == pytest.approx((0, 2 / 3, 0, 0, 1 / 3))
    assert read(first, Stage.VQ, "clarity").evidence_text == "2 of 3 votes"
    assert read(second, Stage.VQ, "clarity").levels == CLEAN  # Ada is unsure
    split, silent = read(second, Stage.VQ, "color"), read(first, Stage.PC, "liquid")
    assert split.status is Status.ABSTAIN and "1 votes pass, 1 fail" in split.reason
    assert silent.status is Status.ABSTAIN and silent.reason == "nobody labelled liquid"
    plan = read(first, Stage.PLAN, "planning")
    assert plan.focus == ("clarity",) and plan.levels == pytest.approx((0, 0, 1 / 3, 2 / 3))
    verdict = asyncio.run(RewardAgent(judge, RUBRIC, mode="benchmark").evaluate(*first))
    (clarity,) = [score for score in verdict.stages[0].components if score.component == "clarity"]
    assert not clarity.passed and clarity.p_fail == pytest.approx(2 / 3)


def test_what_people_pay_does_not_hang_on_the_order_of_their_files(tmp_path: Path) -> None:
    evaluations = judged(tmp_path / "log", [{}])
    said = {
        "Ada": everything(), "Bob": everything(planning=1, clarity=False, robot=False),
        "Cleo": everything(robot=False, **{"hack: occlusion": False}),
    }
    files = [read_labels(write_labels(tmp_path / f"{n}.json", evaluations, [rows], n)) for n, rows in said.items()]
    rubrics = [load_rubric("robot", {"voting": {"audit_share": share}}) for share in (0.0, 1.0)]
    record = read_record(tmp_path / "log")
    for number in (2, 3):
        for rubric in rubrics:
            agents = [RewardAgent(HumanJudge(order, record), rubric) for order in permutations(files[:number])]
            verdicts = [asyncio.run(agent.evaluate(*clips(1)[0])) for agent in agents]
            assert len({verdict.audit_id for verdict in verdicts}) == 1
            assert verdicts[0].valid == (number == 3), "two people who differ pay nothing"


def test_a_person_has_one_vote_on_a_clip_and_none_on_another_task_of_it(tmp_path: Path) -> None:
    """Ada saw the clip twice with one instruction, and changed her mind, and once with another one."""
    clip, red = clips(1)[0]
    green = replace(red, instruction="push the green cube to the mark")
    judge_all(tmp_path, ScriptedJudge(clean_table(RUBRIC)), [(clip, red), (clip, red), (clip, green)])
    record = read_record(tmp_path)
    undone = everything(task_completion=False)
    said = {"Ada": [everything(), undone, everything()], "Bob": [undone]}
    files = [read_labels(write_labels(tmp_path / who, record.judged(), [*rows], who)) for who, rows in said.items()]
    judge = HumanJudge(files, record)

    def levels(task: TaskSpec) -> tuple[float, ...]:
        request = ReadRequest(clip, task, Stage.TC, ("task_completion",), Profile.E, (next_vote(1, 0),), ())
        return asyncio.run(judge.read(request))[0].levels

    assert levels(red) == WRONG and levels(green) == CLEAN
    assert HumanJudge(files[::-1], record).capabilities == judge.capabilities


def test_the_command_names_the_clips_that_are_paid_more_than_people_would(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A judge that passes everything; a person sees a failed task in clip 1, and left clip 2 half labelled."""
    evaluations = judged(tmp_path / "log", [{}, {}, {}, {}])
    rows: list[Mapping[str, Any]] = [everything(), everything(task_completion=False), {"planning": 3, "clarity": True}]
    labels = write_labels(tmp_path / "ada.json", evaluations, rows)
    given = ["people", str(tmp_path / "log"), "--labels", str(labels)]
    assert main(["audit", *given, "--output", str(tmp_path / "people")]) == 0
    out = capsys.readouterr().out
    assert "3 clips, 2 with a reward by people, 2 by both" in out and "people would: 1 of 2" in out
    by_people = read_record(tmp_path / "people").judged()
    paid = [e.verdict.reward for e in by_people]
    assert paid[0] == 1.0 and paid[1] < 0.6 and math.isnan(paid[2])
    assert f"clip1: judge 1.000, people {paid[1]:.3f}" in out
    assert "nobody labelled" in by_people[2].verdict.reason
    assert main(["audit", "verify", str(tmp_path / "people")]) == 0
    assert main(["audit", "replay", str(tmp_path / "people")]) == 0
    with pytest.raises(SystemExit):
        main(["audit", *given])


# --- agreement --------------------------------------------------------------------------------------------------
def rows_of(folder: Path, *paths: Path, weights: Mapping[int, float] | None = None) -> dict[str, AgreementRow]:
    found = join_labels(read_record(folder), [read_labels(path) for path in paths])
    return {row.name: row for row in report(found).rows}


def test_agreement_is_counted_row_by_row_as_worked_by_hand(tmp_path: Path) -> None:
    # clarity, judge: pass x 8, fail x 2. people: fail on clips 0, 8; pass on 1-6, 9; unsure on 7.
    log = tmp_path / "log"
    evaluations = judged(log, [{"clarity": WRONG} if i > 7 else {} for i in range(10)])
    said: list[Mapping[str, Any]] = [{"clarity": (False, False)}, *({"clarity": (True, True)} for _ in range(6)),
                                     {"clarity": None}, {"clarity": False}, {"clarity": True}]
    row = rows_of(log, write_labels(tmp_path / "ada.json", evaluations, said))["clarity"]
    assert (row.n, row.silent, row.unsure, row.people, row.reasons) == (9, 0, 1, 0, 7)
    assert row.accuracy == pytest.approx(7 / 9)
    assert (row.low, row.high) == pytest.approx(wilson_interval(7, 9))
    assert row.prevalence == pytest.approx(2 / 9)
    assert row.balanced == pytest.approx((6 / 7 + 1 / 2) / 2)
    # p_o = 7/9; by chance 7/9 * 7/9 + 2/9 * 2/9 = 53/81
    assert row.kappa == pytest.approx(1 - (2 / 9) / (1 - 53 / 81))
    assert row.calibration == pytest.approx((7 * 1 / 7 + 2 * 1 / 2) / 9)  # bins 1.0 and 0.0: one wrong in each
    assert row.reasons_right == pytest.approx(6 / 7)
    assert row.paper == 100
    assert math.isnan(row.kappa_people)


def test_two_people_are_compared_with_each_other_and_the_first_one_counts(tmp_path: Path) -> None:
    log = tmp_path / "log"
    evaluations = judged(log, [{}, {}, {"robot": WRONG}, {"robot": WRONG}])
    said: list[Mapping[str, Any]] = [{"robot": x} for x in ((True, True), (True, False), False, False)]
    ada = write_labels(tmp_path / "a.json", evaluations, said)
    said = [{"robot": x} for x in ((True, False), False, (False, True), None)]
    bob = write_labels(tmp_path / "b.json", evaluations, said, "Bob")
    row = rows_of(log, ada, bob)["robot"]
    assert (row.n, row.accuracy, row.people) == (4, 1.0, 3)
    assert (row.reasons, row.reasons_right) == (3, pytest.approx(2 / 3))
    assert row.kappa_people == pytest.approx(1 - (1 / 3) / (1 - (2 / 3 * 1 / 3 + 1 / 3 * 2 / 3)))
    assert rows_of(log, bob, ada)["robot"].accuracy == 0.75  # the first who is sure
    with pytest.raises(AuditError, match=r"Ada labelled evaluation \d+ twice"):
        rows_of(log, ada, ada)


def test_stages_and_the_whole_follow_from_labels_and_verdicts(tmp_path: Path) -> None:
    log = tmp_path / "log"
    evaluations = judged(log, [{}, {"clarity": WRONG}, {}])
    parts = dict.fromkeys(("clarity", "brightness", "color", "temporal"), True)
    whole = {**parts, "overall": True}
    said: list[Mapping[str, Any]] = [{**whole, "planning": 3}, {**whole, "planning": 1},
                                     {"clarity": True, "hack: occlusion": True}]
    rows = rows_of(log, write_labels(tmp_path / "a.json", evaluations, said))
    assert (rows["VQ"].n, rows["VQ"].accuracy) == (2, 0.5)
    assert rows["VQ"].unsure == 1  # clip 2: one component is labelled, the others are not
    assert (rows["overall"].n, rows["overall"].accuracy) == (2, 0.5)
    assert (rows["planning"].accuracy, rows["planning"].prevalence, rows["planning"].balanced) == (0.5, 0.5, 0.5)
    assert (rows["hack: occlusion"].n, rows["hack: occlusion"].accuracy) == (1, 1.0)
    assert "IF" not in rows


def test_labels_of_a_sample_are_weighted_to_the_round(tmp_path: Path) -> None:
    log = tmp_path / "log"
    evaluations = judged(log, [{"clarity": WRONG} if i < 5 else {} for i in range(40)])
    sample = draw(read_record(log), 0, size=20)
    weight = {one.evaluation: one.weight for one in sample.chosen}
    chosen = [e for e in evaluations if e.number in weight]
    said: list[Mapping[str, Any]] = [{"clarity": i > 3} for i, _ in enumerate(chosen)]
    files = [read_labels(write_labels(tmp_path / "a.json", chosen, said))]
    row = next(r for r in report(join_labels(read_record(log), files, [sample])).rows if r.name == "clarity")
    passed = [e.verdict.stages[0].components[0].passed for e in chosen]
    right = [ok == (i > 3) for i, ok in enumerate(passed)]
    weights = [weight[e.number] for e in chosen]
    assert len(set(weights)) > 1
    assert row.accuracy == pytest.approx(np.average(right, weights=weights))


def test_labels_that_do_not_belong_to_a_log_are_refused(tmp_path: Path) -> None:
    one, other = judged(tmp_path / "one", [{}]), judged(tmp_path / "other", [{"clarity": WRONG}])
    path = write_labels(tmp_path / "a.json", other, [{"clarity": True}])
    with pytest.raises(AuditError, match="is another one in this log"):
        rows_of(tmp_path / "one", path)
    foreign = write_labels(tmp_path / "b.json", one, [{"sharpness": True}])
    with pytest.raises(AuditError, match="has no row sharpness"):
        rows_of(tmp_path / "one", foreign)
    path.write_text("{}")
    with pytest.raises(AuditError, match=r"a\.json is no exported file of labels: format: Field required"):
        read_labels(path)


# --- commands ---------------------------------------------------------------------------------------------------
def test_other_numbers_are_judged_from_the_old_log_by_a_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    judged(tmp_path / "old", [{}, {"clarity": FLAWED}, {"robot": WRONG}])
    assert main(["audit", "replay", str(tmp_path / "old")]) == 0
    assert "3 of 3 verdicts equal bit for bit" in capsys.readouterr().out
    pack = tmp_path / "strict.yaml"
    pack.write_text("extends: robot\nrevision: 3\nstages: {VQ: {threshold: 0.99}}\n")
    other = ["audit", "replay", str(tmp_path / "old"), "--rubric", str(pack)]
    assert main(other) == 2
    assert main([*other, "--output", str(tmp_path / "new")]) == 0
    assert "3 verdicts under robot-3-" in capsys.readouterr().out
    passed = [e.verdict.stages[0].passed for e in read_record(tmp_path / "new").judged()]
    assert passed == [True, False, True]
    for there in ("new", "old"):
        assert main([*other, "--output", str(tmp_path / there)]) == 2
        assert "holds an audit log already; name a new folder" in capsys.readouterr().err
        assert len(read_record(tmp_path / there).judged()) == 3
    assert main(["audit", "verify", str(tmp_path / "new")]) == 0
    assert main(["audit", "view", str(tmp_path / "new"), "--second"]) == 2
    assert "name it with --sample" in capsys.readouterr().err
    assert main(["audit", "sample", str(tmp_path / "new"), "--output", str(tmp_path / "s.json")]) == 0
    assert read_sample(tmp_path / "s.json").population == 3
    assert main(["audit", "agree", str(tmp_path / "nothing"), "--labels", "x"]) == 2
    assert "name the folder of an audit log" in capsys.readouterr().err


DOCUMENT = Path(__file__).parents[4] / "wm_nodes" / "docs" / "audit.md"


def test_the_round_of_the_document_runs_as_it_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    tables: Tables = [{"clarity": (0.0, 0.0, 1.0, 0.0, 0.0)} if i % 2 else {} for i in range(6)]
    said = [{"clarity": not i % 2} for i in range(6)]
    evaluations = judged(tmp_path / "audit", tables, round_number=3)
    write_labels(Path("labels-Ada.json"), evaluations, said)
    write_labels(Path("labels-Bob.json"), evaluations, said[:2], "Bob")
    Path("next.yaml").write_text("extends: robot\nrevision: 2\nstages: {VQ: {threshold: 0.8}}\n")
    block = DOCUMENT.read_text().split("```bash\n")[1].split("```")[0]
    commands = [line.removeprefix("wm audit ").split() for line in block.splitlines()]
    names = [command[0] for command in commands]
    assert names == ["verify", "sample", "view", "agree", "people", "replay", "replay"]
    assert [main(["audit", *command]) for command in commands] == [0] * len(names)
    assert Path("audit/view.html").is_file() and Path("audit-next/log.jsonl").is_file()
    assert len(read_record(Path("audit-people")).judged()) == 6


def test_every_command_explains_itself(capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("verify", "recover", "sample", "view", "agree", "people", "replay"):
        with pytest.raises(SystemExit, match="0"):
            main(["audit", command, "--help"])
    assert "rubric" in capsys.readouterr().out
