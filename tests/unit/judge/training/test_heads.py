"""Trees, calibration, familiarity and the folder of the embedded judge (RA-18 to RA-20)."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.core.types import FloatArray
from wm_nodes.judge.agent.levels import p_fail_of
from wm_nodes.judge.agent.types import PLANNING
from wm_nodes.judge.dataset.edits.clips import COMPONENTS, TC, ClipTruth, Edit, Origin
from wm_nodes.judge.dataset.edits.manifest import ManifestRow
from wm_nodes.judge.evidence.head import (
    HACK,
    MANIFEST,
    TENSORS,
    HeadQuestion,
    JudgeHead,
    levels_of,
    load_head,
    save_head,
)
from wm_nodes.judge.evidence.segmentation import Segmenter
from wm_nodes.judge.evidence.trees import Trees, TreeSettings, fit_trees
from wm_nodes.judge.training.heads import (
    CONFORMAL,
    PATTERNS,
    TARGETS,
    Examples,
    _flagging_line,
    conformal_errors,
    conformal_limits,
    fit_all,
    fit_familiarity,
    fit_questions,
    measure_target,
    true_levels,
)

SETTINGS = TreeSettings(num_trees=12, depth=2, learning_rate=0.3, row_share=1.0, feature_share=1.0)
NAMES = (*COMPONENTS, TC, *(HACK + name for name in PATTERNS), "idle")
RECIPE = {"occlusion": "occlude_blur", "motion": "freeze", "background": "flatten", "physics": "sunk"}


def row(index: int, fails: set[str], level: int, pattern: str | None) -> ManifestRow:
    edits = () if pattern is None else (Edit(RECIPE[pattern], "fail", 0, 1.0),)
    edits += (Edit("dark", "fail", 0, 0.3),) if "brightness" in fails else ()
    labels = ClipTruth({name: name not in fails for name in COMPONENTS}, level, pattern)  # type: ignore[arg-type]
    return ManifestRow(
        f"{index:064x}", "", Origin("push_cube", "c", "cube/blue", "s", index), edits, labels, "train", "iid"
    )


def examples(count: int, seed: int) -> Examples:
    """Evidence that says of each component, level and pattern whether it fails, with noise of 0.2; one number idles."""
    rng = np.random.default_rng(seed)
    rows, evidence = [], np.zeros((count, len(NAMES)), np.float32)
    for i in range(count):
        fails = {str(name) for name in COMPONENTS if rng.random() < 0.2}
        level, pattern = int(rng.integers(5)), str(rng.choice(PATTERNS)) if rng.random() < 0.4 else None
        rows.append(row(i, fails, level, pattern))
        known = [float(name in fails) for name in COMPONENTS] + [float(level)] + [float(pattern == p) for p in PATTERNS]
        evidence[i] = np.array([*known, 0.0]) + rng.normal(0, 0.2, len(NAMES))
    return Examples(NAMES, evidence, rows)


def trained(seed: int = 0) -> JudgeHead:
    train, validation = examples(240, 1), examples(160, 2)
    low, high = np.quantile(train.evidence, (0.05, 0.95), axis=0).astype(np.float32)
    questions = fit_all(train, validation, SETTINGS, seed, progress=False)
    known = fit_familiarity(train, validation)
    return JudgeHead(Segmenter(), NAMES, questions, known, low, high, (96, 96), (12, 25), {"seed": seed})


@pytest.fixture(scope="module")
def head() -> JudgeHead:
    return trained()


def test_one_split_worked_by_hand() -> None:
    """Four rows, weights 1: p = 0.5, so G = +-1 and H = 0.5 on each side; a leaf is 0.1 * 1 / (0.5 + 4)."""
    rows = np.array([[0.0, 7.0], [1.0, 7.0], [2.0, 7.0], [3.0, 7.0]], np.float32)
    settings = TreeSettings(num_trees=1, depth=1, ridge=4.0, row_share=1.0, feature_share=1.0)
    trees = fit_trees(rows, np.array([False, False, True, True]), np.ones(4), settings, np.random.default_rng(0))
    assert (trees.features[0, 0], trees.thresholds[0, 0], trees.bias) == (0, 1.5, 0.0)
    assert trees.leaves[0] == pytest.approx([-0.1 / 4.5, 0.1 / 4.5])
    assert trees.log_odds(rows) == pytest.approx(np.array([-1, -1, 1, 1]) * 0.1 / 4.5)
    assert trees.importance(2) == pytest.approx([1, 0])


def test_trees_learn_what_no_single_number_tells() -> None:
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(600, 5)).astype(np.float32)
    labels = (rows[:, 1] > 0) ^ (rows[:, 3] > 0)
    trees = fit_trees(rows[:400], labels[:400], np.ones(400), TreeSettings(100, depth=3, feature_share=1.0), rng)
    assert ((trees.log_odds(rows[400:]) > 0) == labels[400:]).mean() > 0.9


def test_where_no_further_question_helps_none_is_asked() -> None:
    """After the second number told all, the first one is of no use: its question is one that every row answers no."""
    rows = np.array([[5.0, 0.0], [6.0, 1.0], [5.0, 1.0], [6.0, 1.0]], np.float32)
    settings = TreeSettings(num_trees=1, depth=2, ridge=4.0, row_share=1.0, feature_share=1.0)
    trees = fit_trees(rows, rows[:, 1] > 0, np.ones(4), settings, np.random.default_rng(0))
    assert trees.features[0].tolist() == [1, 0] and trees.thresholds[0].tolist() == [0.5, np.inf]
    assert trees.log_odds(np.array([[99.0, 1.0]], np.float32)) == trees.log_odds(rows[1:2])


def test_passes_and_fails_weigh_alike_in_training_whatever_their_number(head: JudgeHead) -> None:
    fails = (true_levels("clarity", examples(240, 1).rows) == 0).mean()
    assert fails < 0.3 and head.questions["clarity"][0].trees.bias == pytest.approx(0, abs=1e-9)


def test_labels_that_are_all_alike_and_numbers_that_are_none_are_refused() -> None:
    rows, rng = np.zeros((3, 2), np.float32), np.random.default_rng(0)
    with pytest.raises(ValueError, match="all 3 labels are True"):
        fit_trees(rows, np.ones(3, bool), np.ones(3), SETTINGS, rng)
    with pytest.raises(ValueError, match="finite"):
        fit_trees(rows * np.nan, np.array([True, False, True]), np.ones(3), SETTINGS, rng)
    with pytest.raises(ValueError, match="depth 1 to 8"):
        TreeSettings(depth=0)
    train = examples(40, 0)
    done = [replace(row, labels=ClipTruth(row.labels.components, 4)) for row in train.rows]
    same = Examples(train.names, train.evidence, done)
    with pytest.raises(ValueError, match="task_completion are all above level 0; build larger sets"):
        fit_questions(TC, same, same, SETTINGS, 0)


def test_a_pattern_is_flagged_from_where_most_are_found_at_few_false_flags() -> None:
    odds, absent = np.array([-3.0, -2.0, 0.0, 1.0, 2.0]), np.array([False, False, True, True, True])
    slope, offset = _flagging_line(1.5, odds, absent)
    assert slope == 1.5 and 1 / (1 + np.exp(-(slope * -1.0 + offset))) == pytest.approx(0.2)  # midway, p_present 0.8
    mixed = np.array([False, True, False, True, True])  # finding both would flag one of three: too many
    slope, offset = _flagging_line(1.0, odds, mixed)
    assert 1 / (1 + np.exp(-(-2.5 + offset))) == pytest.approx(0.2)


def test_levels_come_from_the_probabilities_of_being_above_each() -> None:
    assert levels_of("clarity", [0.75]) == (0.0, 0.25, 0.0, 0.0, 0.75)
    assert levels_of(PLANNING, [1.0, 0.8, 0.3]) == pytest.approx((0, 0.2, 0.5, 0.3))
    assert levels_of(TC, [0.9, 0.5, 0.7, 0.1]) == pytest.approx((0.1, 0.4, 0.0, 0.4, 0.1))  # 0.7 counts as 0.5


def test_truth_of_every_target() -> None:
    rows = [row(0, {"clarity"}, 2, "physics"), row(1, {"brightness"}, 4, None), row(2, set(), 4, "motion")]
    assert true_levels("clarity", rows).tolist() == [0, 1, 1]
    assert true_levels(TC, rows).tolist() == [2, 4, 4]
    assert true_levels(HACK + "physics", rows).tolist() == [0, 1, 1]
    assert true_levels(PLANNING, rows).tolist() == [2, 1, 0]
    unknown = replace(rows[0], labels=ClipTruth({"clarity": False}, 2))
    assert true_levels("geometry", [unknown]).tolist() == [-1]


def test_every_head_finds_its_number_on_clips_it_has_not_seen_and_is_calibrated(head: JudgeHead) -> None:
    test = examples(300, 3)
    for target in TARGETS:
        found = measure_target(head.questions, target, test)
        assert found["balanced_accuracy"] > 0.9, (target, found)
        assert target.startswith(HACK) or found["ece"] < 0.08, (target, found)
    assert measure_target(head.questions, TC, test)["level_accuracy"] > 0.85
    text = head.evidence_text("clarity", np.eye(len(NAMES), dtype=np.float32)[:1] * 3)
    assert text.startswith("clarity 3 (clean ") and "idle" not in text


class Slope(HeadQuestion):
    """p_fail rises with the only evidence, 0.5 where that is 0.5; no two clips are alike."""

    def __init__(self) -> None:
        """Without trees."""

    def probability(self, rows: FloatArray) -> NDArray[np.float64]:
        return np.asarray(1 / (1 + np.exp(4 * (rows[:, 0].astype(float) - 0.5))))


def test_conformal_limits_cover_each_class_of_clips_that_did_not_make_them() -> None:
    """As often as promised, over 60 draws of a head that errs in one of six clips; too few clips promise nothing."""
    rng = np.random.default_rng(0)

    def noisy(count: int) -> Examples:
        rows = [row(i, {"clarity"} if i % 4 == 0 else set(), 4, None) for i in range(count)]
        fails = np.array([i % 4 == 0 for i in range(count)])
        return Examples(("x",), (fails + rng.normal(0, 0.5, count)).astype(np.float32)[:, None], rows)

    asked = {"clarity": (Slope(),)}
    kept: dict[str, list[tuple[float, float]]] = {f"{c:g}": [] for c in CONFORMAL}
    for _ in range(60):
        limits, new = conformal_limits(asked, "clarity", noisy(160)), noisy(400)
        p_fail, fails = 1 - asked["clarity"][0].probability(new.evidence), true_levels("clarity", new.rows) == 0
        for coverage, (low, high) in limits.items():
            kept[coverage].append((float((p_fail[fails] >= low).mean()), float((p_fail[~fails] <= high).mean())))
    for coverage, shares in kept.items():
        reached = np.mean(shares, 0)
        assert (reached > float(coverage) - 0.01).all() and (reached < float(coverage) + 0.025).all(), coverage
    few = conformal_limits(asked, "clarity", noisy(8))
    assert few["0.9"] == (0.0, 1.0)


def test_what_abstaining_costs_and_saves_is_counted_by_class() -> None:
    """Evidence x has p_fail 1 / (1 + exp(4 (0.5 - x))): 0.12, 0.31, 0.40, 0.60, 0.69, 0.88; the last is unknown."""
    fails = [False, True, True, False, True, True, None]
    rows = [row(i, {"clarity"} if fail else set(), 4, None) for i, fail in enumerate(fails)]
    rows[-1] = replace(rows[-1], labels=ClipTruth({"robot": False}, 4))
    clips = Examples(("x",), np.array([[0.0], [0.3], [0.4], [0.6], [0.7], [1.0], [0.45]], np.float32), rows)
    found = conformal_errors({"clarity": (Slope(),)}, {"clarity": (0.35, 0.65)}, clips)
    assert found["answered"] == pytest.approx(4 / 7)  # 0.40, 0.60 and the unknown one lie between the limits
    of = found["targets"]["clarity"]
    assert of["silent"] == pytest.approx(3 / 7)
    assert of["fail_as_pass"] == [2 / 4, 1 / 4] and of["pass_as_fail"] == [1 / 2, 0.0]


def test_conformal_limits_of_task_completion_are_of_its_pass_and_fail(head: JudgeHead) -> None:
    held = examples(160, 2)
    low, high = conformal_limits(head.questions, TC, held)["0.8"]
    p_fail = np.array([p_fail_of(head.levels(TC, held.evidence[i : i + 1])) for i in range(160)])
    fails = true_levels(TC, held.rows) < 3
    assert (p_fail[fails] < low).mean() <= 0.2 and (p_fail[~fails] > high).mean() <= 0.2
    assert low in p_fail[fails] and high in p_fail[~fails]


def test_a_coverage_that_was_not_calibrated_is_refused_with_those_that_were(head: JudgeHead) -> None:
    limits = {"clarity": {"0.9": [0.2, 0.7]}}
    known = replace(head, story={"conformal": limits})
    assert known.conformal(0.9) == {"clarity": (0.2, 0.7)}
    with pytest.raises(ValueError, match=r"conformal coverage 0\.5 was not calibrated .* there are: 0\.9"):
        known.conformal(0.5)
    with pytest.raises(ValueError, match="there are: none; train it anew"):
        head.conformal(0.9)


def test_evidence_unlike_training_is_far_and_the_limit_keeps_most_of_validation(head: JudgeHead) -> None:
    known, test = head.familiarity, examples(300, 4)
    assert (known.distance(test.evidence) <= known.limit).mean() > 0.93
    wild = np.full((1, len(NAMES)), 5, np.float32)
    assert known.distance(wild)[0] > 2 * known.limit


def test_a_judge_survives_its_folder_and_equal_seeds_give_equal_bytes(head: JudgeHead, tmp_path: Path) -> None:
    save_head(tmp_path / "a", head)
    loaded = load_head(tmp_path / "a")
    rows = examples(5, 5).evidence
    for target in TARGETS:
        assert [loaded.levels(target, r[None]) for r in rows] == [head.levels(target, r[None]) for r in rows]
    assert loaded.familiarity.limit == head.familiarity.limit and loaded.story["seed"] == 0
    again = save_head(tmp_path / "b", replace(trained(), segmenter=head.segmenter))
    data = (tmp_path / "a" / TENSORS).read_bytes()
    assert data == (again / TENSORS).read_bytes() and len(data) < 2_000_000


def damaged(folder: Path, **changes: object) -> Path:
    manifest = json.loads((folder / MANIFEST).read_text())
    (folder / MANIFEST).write_text(json.dumps(manifest | changes))
    return folder


def test_a_damaged_folder_or_another_list_of_evidence_is_refused(head: JudgeHead, tmp_path: Path) -> None:
    def saved(name: str) -> Path:
        return save_head(tmp_path / name, head)

    with pytest.raises(ModelFolderError, match=r"holds no judge\.json"):
        load_head(tmp_path / "nothing")
    with pytest.raises(ModelFolderError, match="has format 'x'"):
        load_head(damaged(saved("format"), format="x"))
    with pytest.raises(ModelFolderError, match="is not the file its manifest names"):
        load_head(damaged(saved("hash"), sha256="0" * 64))
    with pytest.raises(ModelFolderError, match=r"16 evidence names, but an array \(17,\)"):
        load_head(damaged(saved("evidence"), evidence=list(NAMES[:-1])))
    few = json.loads((saved("lines") / MANIFEST).read_text())["lines"]
    with pytest.raises(ModelFolderError, match="planning has 1 questions, not 2"):
        load_head(damaged(tmp_path / "lines", lines=few | {PLANNING: few[PLANNING][:1]}))
    with pytest.raises(ValueError, match=r"needs evidence .*clarity"):
        head.row({"something": 1.0})
    wide = Trees(np.full((1, 1), 99, np.int32), *(np.zeros((1, n), np.float32) for n in (1, 2, 1)), 0.0)
    bent = replace(head, questions={**head.questions, "clarity": (HeadQuestion(wide, 1.0, 0.0),)})
    with pytest.raises(ModelFolderError, match="trees of clarity do not fit 17 evidence names"):
        load_head(save_head(tmp_path / "trees", bent))
