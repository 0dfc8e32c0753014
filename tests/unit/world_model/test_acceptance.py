"""Acceptance: which numbers let a world model through, and what is refused to be judged."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from pushing_scene import episode, success
from rich.console import Console

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.recording.episode_arrays import EpisodeArrays, stack_episodes
from wm_nodes.world_model import WorldModels
from wm_nodes.world_model.dynamics import ActionModel
from wm_nodes.world_model.tokenizer import Tokenizer
from wm_nodes.world_model.validation.acceptance import AcceptanceReport, accept_world_model, apply_criteria

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


def test_imagined_success_far_above_real_success_fails_and_a_chance_gap_passes() -> None:
    # Newcombe by hand: 90/100 against 80/200 is a gap of +0.50 with an interval well above 0; 45/100 is +0.05.
    assert judged(GOOD, settings(), imagined=(90, 100)).failed == ("SFT policy: imagined 90/100 - real 80/200 success",)
    assert judged(GOOD, settings(), imagined=(45, 100)).passed


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


@pytest.fixture(scope="module")
def heldout() -> EpisodeArrays:
    return stack_episodes((episode(seed) for seed in range(6)), TASKS, success)


@pytest.fixture(scope="module")
def untrained() -> WorldModels:
    config = load_config("smoke")
    torch.manual_seed(0)
    tokenizer = Tokenizer(config.tokenizer.model_copy(update={"width": 32, "depth": 1}), 32, 32).eval()
    small = config.world_model.model_copy(update={"width": 32, "depth": 1, "num_heads": 2})
    sizes = {"num_tokens": tokenizer.num_tokens, "latent_dim": tokenizer.latent_dim, "num_tasks": len(TASKS)}
    action = ActionModel(small, action_dim=3, state_dim=3, **sizes).eval()
    return WorldModels(tokenizer, action, None, TASKS, config.simulation, {})


def test_an_untrained_model_does_not_pass(untrained: WorldModels, heldout: EpisodeArrays) -> None:
    report = accept_world_model(untrained, heldout, settings(), (0, 20), (0, 20))
    assert not report.passed and report.episodes == 6
    assert {"object error / copying, step 12", "tool error / copying, step 12"} <= set(report.failed)
    assert json.loads(json.dumps(report.to_dict(), allow_nan=False))["failed"] == list(report.failed)
    assert {"object_rollout_cm_h01", "object_rollout_cm_h08", "tool_floor_cm_h12"} <= report.metrics.keys()


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
