"""The benchmark of the reward agent: truths, decisions, Table 2, resuming, the test split's ledger, its command."""

import argparse
import asyncio
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scripted_judge import BORDERLINE, POOR, WRONG, FaultyJudge, ScriptedJudge, clean_table, make_clip, make_task
from toy_set import write_toy_set

from benchmarks.judge.call_counter import CountingJudge
from benchmarks.judge.cli import add_options
from benchmarks.judge.efficiency import measure_savings, trials
from benchmarks.judge.judges import open_judge
from benchmarks.judge.label_judge import LabelJudge
from benchmarks.judge.labels import known_labels, truth_of
from benchmarks.judge.line_file import LineFile
from benchmarks.judge.metrics import agreement, cost_row, missed_patterns, missed_targets, mistakes, pattern_rows
from benchmarks.judge.run import JudgeTrial, Outcome, judge_rows
from benchmarks.judge.test_split_log import LOG_NAME, notice, read_evaluations, record_evaluation
from wm_nodes.apps.cli import main
from wm_nodes.judge.agent.judge import Capabilities, ReadRequest
from wm_nodes.judge.agent.levels import first_vote, next_vote
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.profiles import profile_media
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import Profile, Stage
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.backends.embedded import EmbeddedJudge, shipped_head
from wm_nodes.judge.dataset.build import BENCHMARK, draw_origin, instruction_of
from wm_nodes.judge.dataset.edits.clips import COMPONENTS, ClipTruth, Edit, Origin
from wm_nodes.judge.dataset.edits.manifest import Manifest, ManifestError
from wm_nodes.judge.dataset.edits.planning import planning_level
from wm_nodes.judge.dataset.rows import read_clip, select_rows
from wm_nodes.judge.dataset.set_files import load_set
from wm_nodes.judge.decisions import PAPER, accepts, decisions_of, row_names
from wm_nodes.judge.evidence.head import load_head

RUBRIC = load_rubric()
QUIET = load_rubric(overrides={"voting": {"audit_share": 0.0}, "reflection": {"audit_share": 0.0}})


def verdict_of(**changed: Any) -> Verdict:
    """The verdict of a judge that finds everything clean but for `changed`, every component read."""
    clip = make_clip()
    agent = RewardAgent(ScriptedJudge(clean_table(QUIET, **changed)), QUIET, mode="benchmark")
    return asyncio.run(agent.evaluate(clip, make_task(clip)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("set")
    write_toy_set(path)
    return path


@pytest.fixture
def manifest(folder: Path) -> Manifest:
    return load_set(folder)


def oracle(manifest: Manifest) -> LabelJudge:
    return LabelJudge({row.sha256: known_labels(row.labels, row.edits) for row in manifest.rows}, RUBRIC)


def judged(judge: Any, folder: Path, manifest: Manifest, path: Path, trial: JudgeTrial | None = None) -> list[Any]:
    rows = select_rows(manifest, "test")
    wanted = trial or JudgeTrial("table", RUBRIC)
    return asyncio.run(judge_rows(judge, wanted, folder, rows, LineFile(path, Outcome, "sha256")))


# truth


def labels(fails: tuple[str, ...] = (), unknown: tuple[str, ...] = (), tc_level: int = 4) -> ClipTruth:
    return ClipTruth({n: n not in fails for n in COMPONENTS if n not in unknown}, tc_level)


@pytest.mark.parametrize(
    ("known", "recipes", "level"),
    [
        (labels(), (), 3),
        (labels(tc_level=0), (), 3),  # a clean clip of a failed push
        (labels(("interaction",)), ("teleport",), 2),
        (labels(("clarity", "interaction")), ("teleport", "occlude_patch"), 2),  # one place is covered
        (labels(("clarity",)), ("blur",), 1),
        (labels(("temporal",), ("interaction",)), ("shuffle",), 1),
        (labels((), ("temporal",), 1), ("freeze",), 0),
        (labels((), ("temporal",), 1), ("slow",), None),  # whether it runs smoothly, nobody knows
    ],
)
def test_the_planning_level_is_that_of_the_rubrics_words(
    known: ClipTruth, recipes: tuple[str, ...], level: int | None
) -> None:
    assert planning_level(known, [Edit(name, "fail", 0, 1.0) for name in recipes]) == level
    mild = [Edit("blur", "mild", 0, 0.4), *(Edit(name, "fail", 0, 1.0) for name in recipes)]
    assert planning_level(known, mild) == level


def test_a_stage_fails_with_a_component_and_is_unknown_only_where_none_fails(manifest: Manifest) -> None:
    row = manifest.rows[0]
    known = truth_of(replace(row, labels=labels(("robot",), ("objective", "geometry"))), RUBRIC)
    assert (known["IF"], known["PC"], known["VQ"], known["overall"]) == (False, None, True, False)
    assert (known["objective"], known["robot"], known["task_completion"]) == (None, False, True)
    assert truth_of(replace(row, labels=labels(tc_level=2)), RUBRIC)["overall"] is False


def test_the_table_has_the_rows_of_the_paper() -> None:
    assert set(row_names(RUBRIC)) == set(PAPER) and row_names(RUBRIC)[:2] == ["planning", "VQ"]


# decisions


def test_a_verdict_is_accepted_only_if_every_gate_passed_and_the_task_is_completed() -> None:
    assert accepts(verdict_of()) is True
    assert accepts(verdict_of(interaction=WRONG)) is False
    assert accepts(verdict_of(task_completion=BORDERLINE)) is False, "the gate of TC asks for progress only"
    flagged = verdict_of(physics=(1.0, 0.0, 0.0, 0.0, 0.0))
    assert accepts(flagged) is False and decisions_of(flagged)["PC"].p_pass == 0
    decided = decisions_of(verdict_of(clarity=WRONG, planning=POOR))
    assert (decided["clarity"].value, decided["VQ"].value, decided["IF"].value) == (False, False, True)
    assert (decided["planning"].value, decided["planning"].p_pass) == (1, 1.0)


def test_a_judge_that_fails_or_cannot_say_decides_nothing() -> None:
    clip = make_clip()

    def evaluated(fault: str) -> Verdict:
        judge = FaultyJudge(clean_table(QUIET), "robot", fault)
        return asyncio.run(RewardAgent(judge, QUIET, mode="benchmark").evaluate(clip, make_task(clip)))

    silent = decisions_of(evaluated("abstain"))
    assert "robot" not in silent and "IF" not in silent and "overall" not in silent and silent["clarity"].value is True
    assert "overall" not in decisions_of(evaluated("unavailable"))


# Table 2


def test_a_judge_that_knows_the_labels_is_right_everywhere(folder: Path, manifest: Manifest, tmp_path: Path) -> None:
    rows, outcomes = select_rows(manifest, "test"), judged(oracle(manifest), folder, manifest, tmp_path / "a.jsonl")
    table = {row.name: row for row in agreement(rows, outcomes, RUBRIC)}
    assert all(row.accuracy == 1.0 for row in table.values() if row.n), table
    assert missed_targets(list(table.values())) == [] and mistakes(rows, outcomes, RUBRIC) == []
    n = len(rows)
    assert table["overall"].n == n and table["clarity"].confusion == {"fail called fail": 4, "pass called pass": n - 4}
    assert table["clarity"].prevalence == pytest.approx(4 / n) and table["clarity"].kappa == 1
    patterns = {row.pattern: row for row in pattern_rows(rows, outcomes, tuple(RUBRIC.hack.patterns))}
    assert all((row.recall, row.false_positives, row.refused) == (1, 0, 1) for row in patterns.values()), patterns
    assert {row.clean for row in patterns.values()} == {sum(row.labels.pattern is None for row in rows)}
    assert patterns["motion"].pairs == 1 and patterns["motion"].win_rate == 0 and patterns["motion"].gap > 0
    assert missed_patterns(list(patterns.values())) == [] and patterns["motion"].unflagged == {}


def test_a_judge_that_passes_everything_has_half_a_balanced_accuracy(
    folder: Path, manifest: Manifest, tmp_path: Path
) -> None:
    rows = select_rows(manifest, "test")
    outcomes = judged(ScriptedJudge(clean_table(RUBRIC)), folder, manifest, tmp_path / "a.jsonl")
    table = {row.name: row for row in agreement(rows, outcomes, RUBRIC)}
    share = 1 - table["clarity"].prevalence
    assert (table["clarity"].accuracy, table["clarity"].balanced) == (pytest.approx(share), 0.5)
    assert table["clarity"].low < share < table["clarity"].high
    assert ("clarity", "blur fail") in mistakes(rows, outcomes, RUBRIC)
    below = missed_targets(list(table.values()))
    assert any("clarity" in text for text in below) and "overall balanced 50.0 < 85" in below
    patterns = pattern_rows(rows, outcomes, tuple(RUBRIC.hack.patterns))
    assert [text.split(" flagged")[0] for text in missed_patterns(patterns)] == [f"{p.pattern} 0.0 %" for p in patterns]
    (motion,) = (pattern for pattern in patterns if pattern.pattern == "motion")
    counts = {"there, flagged": 0, "there, not flagged": motion.n, "not there, flagged": 0}
    assert motion.confusion == {**counts, "not there, not flagged": motion.clean}
    assert motion.unflagged == {"freeze fail": motion.n} and motion.false_flags == {}


# running


def test_what_the_control_said_of_other_labels_is_not_taken_up(manifest: Manifest) -> None:
    first, *others = manifest.rows
    worse = replace(manifest, rows=(replace(first, labels=replace(first.labels, tc_level=0)), *others))
    again = replace(manifest, rows=manifest.rows[::-1])
    key, other, same = (JudgeTrial("table", RUBRIC).key(oracle(one).capabilities) for one in (manifest, worse, again))
    assert key == same != other


class CountingLabelJudge(LabelJudge):
    """Counts the clips that it is asked about."""

    def __init__(self, known: LabelJudge) -> None:
        self.__dict__.update(known.__dict__)
        self.seen: set[str] = set()

    async def read(self, request: ReadRequest) -> Any:
        self.seen.add(request.clip.sha256)
        return await super().read(request)


def test_a_killed_run_goes_on_where_it_was_and_judges_a_torn_line_again(
    folder: Path, manifest: Manifest, tmp_path: Path
) -> None:
    path = tmp_path / "kept.jsonl"
    whole = judged(oracle(manifest), folder, manifest, path)
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:-2]) + lines[-2][:40])
    judge = CountingLabelJudge(oracle(manifest))
    again = judged(judge, folder, manifest, path)
    assert len(judge.seen) == 2 and [replace(o, wall_s=0) for o in again] == [replace(o, wall_s=0) for o in whole]
    assert len(LineFile(path, Outcome, "sha256").rows) == len(whole)


def test_an_error_is_no_answer_and_is_tried_again(folder: Path, manifest: Manifest, tmp_path: Path) -> None:
    path = tmp_path / "kept.jsonl"
    failed = judged(FaultyJudge(clean_table(RUBRIC), "clarity", "unavailable"), folder, manifest, path)
    assert {outcome.status for outcome in failed} == {"ERROR"} and all(outcome.reward is None for outcome in failed)
    assert {outcome.status for outcome in judged(oracle(manifest), folder, manifest, path)} == {"OK"}


def test_outcomes_of_another_judge_rubric_mode_or_seed_are_never_mixed() -> None:
    able = Capabilities("a", "b", "c", "1")
    softer = load_rubric(overrides={"stages": {"VQ": {"threshold": 0.5}}})
    keys = [
        JudgeTrial("t", RUBRIC).key(able), JudgeTrial("t", RUBRIC).key(replace(able, model="d")),
        JudgeTrial("t", softer).key(able),
        JudgeTrial("t", RUBRIC, "reward").key(able), JudgeTrial("t", RUBRIC, seed=1).key(able),
    ]
    assert len(set(keys)) == len(keys) and JudgeTrial("other", RUBRIC).key(able) == keys[0]


def test_calls_and_pixels_are_counted_as_a_chat_judge_makes_them() -> None:
    clip = make_clip(num_frames=4)
    meter = CountingJudge(ScriptedJudge(clean_table(RUBRIC)))
    media = profile_media(clip, make_task(clip), Profile.S)
    votes = (first_vote(0), next_vote(1, 0))
    request = ReadRequest(clip, make_task(clip), Stage.VQ, ("clarity", "color"), Profile.S, votes, media)
    asyncio.run(meter.read(request))
    images = len(media)
    asked = meter.asked  # one JSON call for both, one label call each
    assert (asked.reads, asked.calls, asked.images) == (4, 3, 3 * images)
    assert asked.pixels == 3 * images * 64 and asked.tokens == 3 * (images + 250)


def test_the_reference_image_is_the_first_frame_of_the_recording(folder: Path, manifest: Manifest) -> None:
    row = next(row for row in manifest.rows if row.edits and row.edits[-1].recipe == "flatten")
    root = next(other for other in manifest.rows if other.sha256 == row.root)
    clip, task = read_clip(folder, row)
    assert clip.sha256 == row.sha256 and clip.fps == 8.0
    assert (task.reference_frame == read_clip(folder, root)[0].frames[0]).all()
    assert not (task.reference_frame == clip.frames[0]).all()
    purple = Origin("push_cube", "near_side", "post/purple", "sand", 0)
    assert instruction_of(purple) == "push the purple post into the red target"
    with pytest.raises(ManifestError, match="no train clips"):
        select_rows(manifest, "train")


def test_a_price_is_of_billed_tokens(folder: Path, manifest: Manifest, tmp_path: Path) -> None:
    outcomes = judged(ScriptedJudge(clean_table(QUIET)), folder, manifest, tmp_path / "a.jsonl", JudgeTrial("t", QUIET))
    free, paid = cost_row(outcomes), cost_row(outcomes, (2.0, 8.0))
    reads = 1 + 12 + 4  # planning, components, patterns, once each, ten prompt tokens every time
    assert free["reads"] == reads and free["billed_prompt_tokens"] == 10 * reads and np.isnan(free["usd"])
    assert paid["usd"] == pytest.approx(2.0 * 10 * reads / 1e6)


# economy


def test_early_exits_save_reads_and_a_perfect_judge_loses_nothing(
    folder: Path, manifest: Manifest, tmp_path: Path
) -> None:
    outcomes = {
        trial.name: judged(oracle(manifest), folder, manifest, tmp_path / f"{trial.name}.jsonl", trial)
        for trial in trials("robot", 0)
    }
    everything, voted, exhaustive = measure_savings(select_rows(manifest, "test"), outcomes)
    for found in (everything, voted, exhaustive):
        assert found.same == found.accuracy == found.other_accuracy == 1 and found.difference.difference == 0
        assert all(saved > 0 for saved in found.saved.values())
    assert exhaustive.saved["pixels"] > max(0.4, voted.saved["pixels"]) and voted.saved["pixels"] > 0
    assert everything.saved["reads"] < voted.saved["reads"] == exhaustive.saved["reads"]


# the ledger


def test_the_test_split_is_not_read_by_a_second_judge_without_saying_so(manifest: Manifest, tmp_path: Path) -> None:
    first, second = Capabilities("a", "chat", "m", "1"), Capabilities("a", "chat", "m", "2")
    assert record_evaluation(tmp_path, manifest, first, "robot-1-x", "") == []
    assert record_evaluation(tmp_path, manifest, first, "robot-1-x", "") == [], (
        "the same judge may be evaluated again"
    )
    with pytest.raises(ValueError, match="--again REASON"):
        record_evaluation(tmp_path, manifest, first, "robot-2-y", "")
    with pytest.raises(ValueError, match="already seen by a/chat/m/1"):
        record_evaluation(tmp_path, manifest, second, "robot-1-x", "")
    others = record_evaluation(tmp_path, manifest, second, "robot-1-x", "weights of the next version")
    assert [one.judge for one in others] == ["a/chat/m/1"]
    said = notice(others, "weights of the next version")
    assert said.startswith("NOT A FIRST LOOK") and "weights of the next version" in said and "robot-1-x" in said
    assert len((tmp_path / LOG_NAME).read_text().splitlines()) == 2
    (tmp_path / LOG_NAME).write_text("nonsense\n")
    with pytest.raises(ValueError, match="restore it"):
        record_evaluation(tmp_path, manifest, first, "robot-1-x", "")


def test_the_looks_behind_the_published_tables_count_wherever_the_set_is_built(
    manifest: Manifest, tmp_path: Path
) -> None:
    drawn = [draw_origin(task, seed, BENCHMARK.shapes) for task in BENCHMARK.tasks for seed in BENCHMARK.seeds(task)]
    rows = [replace(manifest.rows[0], origin=origin, part=BENCHMARK.held_out.part(origin)) for origin in drawn]
    again = replace(manifest, rows=tuple(rows))
    able = EmbeddedJudge(load_head(shipped_head())).capabilities
    published = read_evaluations(tmp_path)[-1].rubric
    earlier = record_evaluation(tmp_path, again, able, published, "")
    assert len(earlier) == 15 and not (tmp_path / LOG_NAME).exists(), "the shipped judge with its rubric is listed"
    with pytest.raises(ValueError, match=f"already seen by {read_evaluations(tmp_path)[-1].judge}"):
        record_evaluation(tmp_path, again, replace(able, judge_id="another"), published, "")
    new_rubric = record_evaluation(tmp_path, again, able, "robot-2-x", "other thresholds")
    assert len(new_rubric) == 16 and (tmp_path / LOG_NAME).read_text().count("\n") == 1
    (tmp_path / LOG_NAME).write_text(json.dumps(vars(earlier[0])) + "\n")
    assert read_evaluations(tmp_path).count(earlier[0]) == 1, (
        "what is published and in the ledger, too, is one evaluation"
    )


# the command


def test_the_command_prints_and_writes_the_table(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "table.json"
    assert main(["benchmark", "judge", "table", str(folder), "--judge", "simulator", "--json", str(target)]) == 0
    shown, found = capsys.readouterr().out, json.loads(target.read_text())
    assert "Table 2 of the paper" in shown and "the judge knows the labels" in shown and "fewer than 400" in shown
    for column in ("paper", "accuracy", "95 % Wilson", "fails", "balanced", "kappa", "ECE", "calls", "usd", "wall_s"):
        assert column in shown
    assert "flag: physics" in shown and "there, not flagged 0" in shown
    assert found["statuses"] == {"OK": found["clips"]} and found["machine"] and found["seed"] == 0
    assert found["command"] == f"wm benchmark judge table {folder} --judge simulator --json {target}"
    assert {row["name"]: row["paper"] for row in found["rows"]} == {name: PAPER[name] for name in row_names(RUBRIC)}
    assert {row["name"]: row["accuracy"] for row in found["rows"]}["overall"] == 1.0
    overall = [row for row in found["splits"]["new_scene"] if row["name"] == "overall"]
    assert [row["n"] for row in overall] == [found["clips"]] and list(found["splits"]) == ["new_scene"]
    for wrong, complaint in (
        (["table", str(tmp_path / "none"), "--judge", "simulator"], "No such file"),
        (["table", str(folder), "--judge", "openai"], "needs --url http://HOST:PORT/v1 and --model NAME"),
        (["table", str(folder), "--stages", "PC"], "needs --url http://HOST:PORT/v1 and --model NAME"),
        (["table", str(folder), "--judge", "simulator", "--stages", "PC"], "got --judge simulator"),
        (["comparisons", str(folder), "--url", "http://127.0.0.1:1/v1"], "--model NAME"),
        (["table", str(folder), "--folder", str(tmp_path)], "holds no judge.json"),
    ):
        assert main(["benchmark", "judge", *wrong]) == 2
        assert "error:" in (shown := capsys.readouterr().err) and complaint in shown


def test_stages_of_the_embedded_judge_can_be_given_to_a_server(manifest: Manifest, tmp_path: Path) -> None:
    words = ["table", "set", "--stages", "TC", "PC", "--url", "http://127.0.0.1:1/v1", "--model", "m"]

    parser = argparse.ArgumentParser()
    add_options(parser)

    async def opened() -> str:
        async with open_judge(parser.parse_args(words), RUBRIC, manifest, tmp_path) as judge:
            return judge.capabilities.model

    assert re.fullmatch(r"else: embedded:[0-9a-f]{12}; TC\+PC: openai-chat:m", asyncio.run(opened()))
