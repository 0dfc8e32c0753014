"""Acceptance: which numbers let a world model through, and what is refused to be judged."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from model_folders import spec_of
from pushing_scene import episode, stacked_scene
from rich.console import Console

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.world_model import WorldModels
from wm_nodes.world_model.dynamics import ActionModel
from wm_nodes.world_model.folder import read_world_manifest
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.validation.acceptance import (
    CloneRollouts,
    accept_world_model,
    accepted_when_made,
    apply_criteria,
    report_when_made,
)
from wm_nodes.world_model.validation.acceptance_report import AcceptanceReport

TASKS = ("reach", "push_cube")
GOOD = {
    "object_moved_ratio_h16": 0.4, "tool_ratio_h16": 0.1, "object_floor_cm_h16": 0.5, "tool_floor_cm_h16": 0.4,
    "done_push_cube_precision": 0.9, "done_push_cube_recall": 0.8,
    "done_reach_precision": 0.9, "done_reach_recall": 0.8,
}


def settings(task: str = "push_cube", **changes: object) -> RunConfig:
    limits = {
        "object_error_ratio": 0.6, "tool_error_ratio": 0.3, "done_precision": 0.8, "done_recall": 0.6,
        "require_success_agreement": True,
    }
    overrides = {f"acceptance.{name}": value for name, value in (limits | changes).items()}
    return load_config("smoke", {"task": task, **overrides})


def judged(metrics: dict[str, float], config: RunConfig, imagined=(40, 100), real=(80, 200)) -> AcceptanceReport:  # type: ignore[no-untyped-def]
    criteria, notes = apply_criteria(metrics, config, 16, imagined, real)
    return AcceptanceReport(config.task, 96, criteria, metrics, notes)


def test_of_states_the_commanded_tool_is_not_judged() -> None:
    criteria, notes = apply_criteria({**GOOD, "tool_ratio_h16": 0.9}, settings(), 16, (40, 100), (80, 200), told=True)
    assert not any(row.name.startswith("tool") for row in criteria) and len(criteria) == 4
    assert any(note.startswith("The tool's error is not judged") for note in notes)


def test_a_model_within_every_limit_passes() -> None:
    report = judged(GOOD, settings())
    assert report.passed and not report.failed and len(report.criteria) == 5


@pytest.mark.parametrize(
    ("name", "value", "failed"),
    [
        ("object_moved_ratio_h16", 0.61, "object error / copying, step 16"),
        ("tool_ratio_h16", 0.31, "tool error / copying, step 16"),
        ("done_push_cube_precision", 0.79, "done precision on rollouts"),
        ("done_push_cube_recall", 0.59, "done recall on rollouts"),
    ],
)
def test_each_number_beyond_its_limit_fails_alone_and_names_a_remedy(name: str, value: float, failed: str) -> None:
    report = judged(GOOD | {name: value}, settings())
    assert report.failed == (failed,) and not report.passed
    assert all(criterion.remedy for criterion in report.criteria if not criterion.passed)


def test_a_limit_itself_still_passes() -> None:
    edge = {"object_moved_ratio_h16": 0.6, "tool_ratio_h16": 0.3, "done_push_cube_precision": 0.8}
    assert judged(GOOD | edge | {"done_push_cube_recall": 0.6}, settings()).passed


def test_an_undefined_number_fails_and_is_null_in_json() -> None:
    report = judged(GOOD | {"done_push_cube_recall": float("nan")}, settings())
    assert report.failed == ("done recall on rollouts",)
    values = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    assert values["passed"] is False and values["metrics"]["done_push_cube_recall"] is None
    assert values["criteria"][3]["value"] is None


def test_imagined_success_far_above_real_success_fails() -> None:
    # Newcombe by hand: 90/100 against 80/200 is a gap of +0.50 with an interval well above 0.
    assert judged(GOOD, settings(), imagined=(90, 100)).failed == ("SFT policy: imagined 90/100 - real 80/200 success",)


@pytest.mark.parametrize(
    ("imagined", "real", "outcome"),
    [
        ((8, 20), (8, 20), "undecided"),  # no gap at all, but an interval of -0.29 to +0.29: 20 episodes pass nothing
        ((0, 4), (4, 4), "failed"),  # beyond the margin and beyond chance, however few
        ((45, 100), (80, 200), "undecided"),  # +0.05, -0.07 to +0.17
        ((900, 2000), (800, 2000), "passed"),  # the same +0.05, +0.02 to +0.08: not 0, and too small to matter
        ((1080, 2000), (800, 2000), "undecided"),  # +0.14, to +0.17
        ((1200, 2000), (800, 2000), "failed"),  # +0.20
    ],
)
def test_agreement_is_an_equivalence_test_which_too_few_episodes_do_not_pass(
    imagined: tuple[int, int], real: tuple[int, int], outcome: str
) -> None:
    report = judged(GOOD, settings(), imagined, real)
    assert report.outcome == outcome and report.passed == (outcome == "passed")
    assert report.to_dict()["outcome"] == outcome
    wider = judged(GOOD, settings(success_margin=0.4), imagined, real)
    assert wider.outcome == ("failed" if imagined == (0, 4) else "passed")


def test_success_in_one_world_only_is_not_judged_and_the_report_says_so() -> None:
    report = judged(GOOD, settings(), real=None)
    assert report.passed and len(report.criteria) == 4
    assert any("not judged" in note for note in report.notes)


def test_agreement_that_was_not_asked_for_is_not_judged() -> None:
    report = judged(GOOD, settings(require_success_agreement=False), imagined=(99, 100))
    assert report.passed and any("not asked for" in note for note in report.notes)


def test_reach_is_judged_by_its_tool_and_not_by_an_object_that_stays() -> None:
    report = judged(GOOD | {"object_moved_ratio_h16": float("nan")}, settings("reach"))
    assert report.passed and not any("object" in criterion.name for criterion in report.criteria)
    assert any("object hardly moves in reach" in note for note in report.notes)


def test_the_table_shows_every_criterion_and_the_remedy_of_a_failed_one() -> None:
    console = Console(width=200, record=True, quiet=False, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(judged(GOOD | {"tool_ratio_h16": 0.9}, settings()).table())
    text = console.export_text()
    assert "acceptance FAILED" in text and "done recall on rollouts" in text and "train longer" in text


def clone(hits: int, false: int, missed: int, others: int = 0) -> CloneRollouts:
    """Rollouts by how many are imagined and replayed successes, imagined ones alone, replayed ones alone, neither."""
    counts = [hits, false, missed, others]
    replayed = np.repeat([True, False, True, False], counts)
    return CloneRollouts(np.repeat([True, True, False, False], counts), replayed, replayed)


@pytest.mark.parametrize(
    ("found", "precision", "recall"),
    [
        (clone(27, 3, 3, 31), "passed", "passed"),  # 27/30 both: 0.74 to 0.97
        (clone(30, 15, 25), "failed", "undecided"),  # 30/45: to 0.79; 30/55: 0.42 to 0.67
        (clone(6, 4, 30), "undecided", "failed"),  # 6/10: 0.31 to 0.83; 6/36: to 0.32
        (clone(1, 0, 0, 63), "undecided", "undecided"),  # 1/1 says nothing
        (clone(0, 0, 0, 64), "undecided", "undecided"),  # nor does a policy that never succeeds
        (clone(18, 6, 4), "undecided", "passed"),  # 18/24: 0.55 to 0.88
    ],
)
def test_the_done_signal_is_judged_on_rollouts_of_the_cloned_policy_too(
    found: CloneRollouts, precision: str, recall: str
) -> None:
    criteria, _ = apply_criteria(GOOD, settings(), 16, (40, 100), (80, 200), [found])
    own = {row.name.split(",")[0]: row for row in criteria if "cloned policy" in row.name}
    assert (own["done precision"].outcome, own["done recall"].outcome) == (precision, recall)
    assert all(row.interval is not None and row.remedy for row in own.values())


def test_in_further_scenes_the_done_signal_is_judged_alone() -> None:
    elsewhere = replace(clone(30, 15, 25), scenes="ood_object")
    criteria, _ = apply_criteria(GOOD, settings(), 16, (70, 100), (70, 100), [clone(46, 13, 3), elsewhere])
    asked = {row.name.split(" (")[0]: row.outcome for row in criteria if "cloned policy" in row.name}
    assert asked == {
        "done precision, cloned policy": "undecided", "done recall, cloned policy": "passed",
        "room to learn: done precision, cloned policy - its real success 70/100": "passed",
        "done precision, cloned policy, ood_object": "failed", "done recall, cloned policy, ood_object": "undecided",
    }


def test_a_model_that_only_scripted_episodes_speak_for_is_refused_by_the_cloned_policy() -> None:
    criteria, _ = apply_criteria(GOOD, settings(), 16, (40, 100), (80, 200), [clone(40, 40, 10)])
    report = AcceptanceReport("push_cube", 96, criteria, GOOD)
    assert report.failed == ("done precision, cloned policy (80)",) and report.words.startswith("failed (done prec")


@pytest.mark.parametrize(
    ("real", "found", "outcome"),
    [
        ((195, 200), clone(60, 4, 3), "failed"),  # 94 % against 97.5 %: less than what it has, by however little
        ((91, 100), clone(46, 13, 3), "failed"),
        ((70, 100), clone(46, 13, 3), "passed"),
        ((70, 100), clone(3, 1, 3), "undecided"),
        ((70, 100), clone(0, 0, 3), "undecided"),
    ],
)
def test_a_policy_that_the_model_could_only_lower_is_not_trained_in_it(
    real: tuple[int, int], found: CloneRollouts, outcome: str
) -> None:
    criteria, _ = apply_criteria(GOOD, settings(), 16, (90, 100), real, [found])
    room = next(row for row in criteria if row.name.startswith("room to learn"))
    assert room.outcome == outcome and f"{real[0]}/{real[1]}" in room.name and "keep this policy" in room.remedy


def test_a_policy_that_mostly_fails_has_nothing_to_keep() -> None:
    criteria, _ = apply_criteria(GOOD, settings(), 16, (90, 100), (32, 100), [clone(2, 10, 3)])
    assert not [row for row in criteria if row.name.startswith("room to learn")], "RL in the model won 19 points"


def test_intervals_of_the_held_out_numbers_stand_beside_them() -> None:
    known = GOOD | {
        "object_moved_ratio_low_h16": 0.3, "object_moved_ratio_high_h16": 0.5,
        "done_push_cube_precision_low": 0.7, "done_push_cube_precision_high": 0.95,
    }
    criteria, _ = apply_criteria(known, settings(), 16, None, None)
    assert [row.interval for row in criteria[:1]] == [(0.3, 0.5)] and criteria[1].interval is None
    assert criteria[2].interval == pytest.approx((0.7, 0.95))


def test_what_a_models_manifest_says_stands_in_for_a_measurement() -> None:
    config = load_config("cpu", {"task": "push_cube"})
    cube = read_world_manifest(shipped_model("push_cube"))
    assert accepted_when_made(cube, config).startswith("passed on 150 held-out episodes when it was made")
    scenes = load_config("cpu", {"task": "push"})
    found = accepted_when_made(read_world_manifest(shipped_model("push")), scenes)
    assert found.startswith("passed on 64 held-out episodes")
    strict = scenes.with_values(acceptance=scenes.acceptance.with_values(object_error_ratio=1e-3))
    assert accepted_when_made(read_world_manifest(shipped_model("push")), strict).startswith("failed (object error")
    assert accepted_when_made({}, config).startswith("not judged: the model's manifest holds no metrics")


BY_PICTURES = {
    "done_stir_in_time": 0.9, "done_stir_in_time_low": 0.7, "done_stir_in_time_high": 0.95,
    "done_stir_recall": 0.8, "done_stir_recall_low": 0.6, "done_stir_recall_high": 0.9,
    "done_stir_auc": 0.87, "done_stir_real_rate": 0.4,
    "feature_episodes_h08": 20.0, "feature_episodes_h16": 9.0,
    "feature_ratio_h08": 0.5, "feature_ratio_low_h08": 0.4, "feature_ratio_high_h08": 0.6,
    "other_actions_h08": 1.3, "other_actions_low_h08": 1.1, "other_actions_high_h08": 1.5,
    "varying_error_h00": 0.2, "varying_error_h01": 0.1, "varying_error_h16": 9.0,
}


def judged_by_pictures(**changes: float) -> AcceptanceReport:
    config = settings().model_copy(update={"task": "stir"})
    return judged(BY_PICTURES | changes, config, None, None)


def test_a_model_without_positions_passes_by_its_done_signal_its_pictures_and_its_actions() -> None:
    report = judged_by_pictures()
    assert report.passed and [(row.name, row.value) for row in report.criteria] == [
        ("done precision in time on rollouts", 0.9), ("done recall on rollouts", 0.8),
        ("feature distance / copying, step 8", 0.5), ("feature distance, other / recorded actions, step 8", 1.3),
        ("varying pixels, unexplained, step 0", 0.2),
    ]
    notes = " ".join(report.notes)
    for words in ("Positions were not judged", "AUC of the done signal: 0.87, chance is 0.5",
                  "up to step 8, which half of the held-out episodes reach; imagined episodes have up to 16",
                  "Agreement of imagined and real success was not judged"):
        assert words in notes


@pytest.mark.parametrize(
    ("changes", "outcome", "due_to"),
    [
        ({"feature_ratio_h08": 0.9}, "failed", "feature distance / copying, step 8"),
        ({"feature_ratio_h08": np.nan}, "failed", "feature distance / copying, step 8"),
        ({"other_actions_h08": 1.0, "other_actions_low_h08": 1.0, "other_actions_high_h08": 1.01}, "failed",
         "other / recorded actions, step 8"),
        ({"varying_error_h04": 0.9}, "failed", "varying pixels, unexplained, step 4"),
        ({"other_actions_low_h08": 0.9}, "undecided", "other / recorded actions, step 8"),
        ({"done_stir_recall": 0.3, "done_stir_recall_high": 0.5}, "failed", "done recall on rollouts"),
        ({"done_stir_recall": 0.3, "done_stir_recall_high": 0.7}, "undecided", "done recall on rollouts"),
        ({"done_stir_in_time": 0.9, "done_stir_in_time_low": 0.5}, "undecided", "done precision in time on rollouts"),
        ({"done_stir_in_time": 0.1, "done_stir_in_time_low": 0.02, "done_stir_in_time_high": 0.3}, "failed",
         "done precision in time on rollouts"),  # paid at once, whatever happens later
        ({"done_stir_in_time": np.nan}, "undecided", "done precision in time on rollouts"),
    ],
)
def test_without_positions_each_criterion_alone_keeps_a_model_back(
    changes: dict[str, float], outcome: str, due_to: str
) -> None:
    report = judged_by_pictures(**changes)
    (name,) = report.failed or report.undecided
    assert report.outcome == outcome and name.endswith(due_to)


def test_what_recordings_cannot_show_is_named_and_not_judged() -> None:
    report = judged_by_pictures(
        done_stir_real_rate=1.0, done_stir_auc=np.nan, other_actions_low_h08=np.nan, other_actions_h08=np.nan,
        varying_error_h00=np.nan, varying_error_h01=np.nan,
    )
    assert [row.name for row in report.criteria] == [
        "done precision in time on rollouts", "done recall on rollouts", "feature distance / copying, step 8"
    ]
    notes = " ".join(report.notes)
    for words in ("AUC of the done signal was not judged", "Sensitivity to actions was not judged",
                  "What the tokenizer loses was not judged"):
        assert words in notes


def test_a_truth_without_positions_is_judged_by_what_the_pictures_said_when_the_model_was_made() -> None:
    config = settings().model_copy(update={"task": ""})
    manifest = {
        "spec": {"task": "stir", "max_episode_steps": 16, "ground_truth_names": ["wetness"]},
        "heldout": {**BY_PICTURES, "episodes": 20.0}, "success_threshold": config.reward.success_threshold,
    }
    report = report_when_made(manifest, config)
    assert report.passed and report.episodes == 20 and len(report.criteria) == 5


@pytest.fixture(scope="module")
def heldout() -> EpisodeArrays:
    return stacked_scene((episode(seed) for seed in range(6)), TASKS)


@pytest.fixture(scope="module")
def untrained() -> WorldModels:
    config = load_config("smoke")
    torch.manual_seed(0)
    tokenizer = Tokenizer(config.tokenizer.model_copy(update={"width": 32, "depth": 1}), 32, 32).eval()
    small = config.world_model.model_copy(update={"width": 32, "depth": 1, "num_heads": 2})
    sizes = {"num_tokens": tokenizer.num_tokens, "latent_dim": tokenizer.latent_dim, "num_tasks": len(TASKS)}
    action = ActionModel(small, action_dim=3, state_dim=3, **sizes).eval()
    return WorldModels(tokenizer, action, None, TASKS, spec_of(config, tokenizer), {})


def test_an_untrained_model_does_not_pass(untrained: WorldModels, heldout: EpisodeArrays) -> None:
    report = accept_world_model(untrained, heldout, settings(), (0, 20), (0, 20))
    assert not report.passed and report.episodes == 6
    assert {"object error / copying, step 12", "tool error / copying, step 12"} <= set(report.failed)
    assert json.loads(json.dumps(report.to_dict(), allow_nan=False))["failed"] == list(report.failed)
    assert {"object_rollout_cm_h01", "object_rollout_cm_h08", "tool_floor_cm_h12"} <= report.metrics.keys()


def test_episodes_of_more_than_64_steps_are_judged_by_their_last_one(
    untrained: WorldModels, heldout: EpisodeArrays
) -> None:
    first = heldout.select([0, 1])
    parts = {name: getattr(first, name) for name in ("images", "states", "actions", "ground_truth", "success")}
    six = {name: np.concatenate([part[:, :12]] * 6, 1) for name, part in parts.items()}
    frames = {name: np.concatenate([six[name], parts[name][:, -1:]], 1) for name in six if name != "actions"}
    long = replace(first, **frames, actions=six["actions"], lengths=first.lengths * 0 + 72)
    report = accept_world_model(untrained, long, settings())
    values = {row.name: row.value for row in report.criteria}
    assert all(np.isfinite(values[f"{thing} error / copying, step 72"]) for thing in ("object", "tool"))


def test_episodes_without_ground_truth_are_refused(untrained: WorldModels, heldout: EpisodeArrays) -> None:
    unknown = heldout.ground_truth.copy()
    unknown[2] = np.nan
    with pytest.raises(ValueError, match=r"1 of 6 held-out episodes carry no ground truth.*simulator episodes"):
        accept_world_model(untrained, replace(heldout, ground_truth=unknown), settings())


def test_episodes_labelled_for_other_tasks_than_the_models_are_refused(
    untrained: WorldModels, heldout: EpisodeArrays
) -> None:
    with pytest.raises(ValueError, match="labelled for push_cube, reach, the world model knows reach, push_cube"):
        accept_world_model(untrained, replace(heldout, tasks=("push_cube", "reach")), settings())


def test_a_task_the_model_does_not_know_is_refused(untrained: WorldModels, heldout: EpisodeArrays) -> None:
    with pytest.raises(ValueError, match="knows the tasks reach, push_cube, not 'pull_cube'"):
        accept_world_model(untrained, heldout, settings("pull_cube"))
