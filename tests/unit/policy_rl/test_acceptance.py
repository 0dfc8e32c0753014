"""Acceptance before a training: held-out episodes and the cloned policy's own rollouts, in the real simulator."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from graph.toy import GOAL_M, ReachToy, make_policy
from model_folders import make_model_folder, make_stepped_folder
from unit.policy_rl.test_exploit_meter import SEEDS, ToyModel

from wm_nodes.config.load import load_config
from wm_nodes.core.types import BoolArray, FloatArray, Observation, StepResult, UInt64Array
from wm_nodes.policy_rl import factories
from wm_nodes.policy_rl.validation import exploit_meter
from wm_nodes.policy_rl.validation.acceptance import accept_model, acceptance_when_made
from wm_nodes.policy_rl.validation.exploit_meter import imagine_and_replay, measure_exploit

CONFIG = load_config("smoke", {"data.num_workers": 1, "acceptance.num_episodes": 4, "acceptance.clone_episodes": 3})


def test_imagined_and_replayed_success_are_those_of_a_reading_of_every_start() -> None:
    policy, model = make_policy(load_config("smoke")), ToyModel(4, 0)
    model.claims = True
    imagined, replayed, held = imagine_and_replay(policy, model, ReachToy(1, 0), SEEDS, 0)
    whole = measure_exploit(policy, model, ReachToy(3, 0), SEEDS, len(SEEDS), 0)
    np.testing.assert_array_equal(imagined, whole.imagined)
    np.testing.assert_array_equal(replayed, whole.replayed)
    assert imagined.all() and 0 < replayed.sum() < len(SEEDS)
    np.testing.assert_array_equal(held, replayed)


class _Lagging(ReachToy):
    """Does what it was told a step before."""

    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        self._told = np.zeros((1, 3), np.float32)
        return super().reset(mask, seeds)

    def step(self, actions: FloatArray) -> StepResult:
        told, self._told = self._told, actions
        return super().step(told)


def test_a_success_that_the_model_sees_too_early_is_real_where_the_robot_holds_still(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    def towards_goal(policy: object, observation: Observation) -> FloatArray:
        return np.clip((GOAL_M - observation.state) / 0.03, -1, 1)

    monkeypatch.setattr(exploit_meter, "act_in_rows", towards_goal)
    policy, model = make_policy(load_config("smoke")), ToyModel(4, 0)
    imagined, replayed, held = imagine_and_replay(policy, model, _Lagging(1, 0), SEEDS, 0)
    assert imagined.all() and replayed.sum() < len(SEEDS) / 2
    np.testing.assert_array_equal(held, imagined)


class _Blind(ReachToy):
    """Without pictures nothing is read off them: one value of the state is not known."""

    def reset(self, mask: BoolArray | None = None, seeds: UInt64Array | None = None) -> Observation:
        shown = super().reset(mask, seeds)
        return replace(shown, state=np.where([False, False, True], np.float32(np.nan), shown.state))


@pytest.mark.parametrize("simulator", [ReachToy, _Blind])
def test_starts_that_the_simulator_does_not_show_are_refused_without_pictures_too(simulator: type[ReachToy]) -> None:
    policy, model = make_policy(load_config("smoke")), ToyModel(4, 0)
    imagine_and_replay(policy, model, simulator(1, 0), SEEDS, 0)
    with pytest.raises(ValueError, match="first frames are not what the simulator shows"):
        imagine_and_replay(policy, model, simulator(1, 0), SEEDS[::-1].copy(), 0)


@pytest.mark.slow
@pytest.mark.rendering
def test_a_model_is_judged_by_held_out_episodes_and_by_the_cloned_policy_in_it(tmp_path: Path) -> None:
    model, folder = make_model_folder(tmp_path / "model", CONFIG), tmp_path / "heldout"
    policy = factories.make_policy(CONFIG, model)
    report = accept_model(CONFIG, model, policy, (2, 8), (2, 8), folder)
    kinds = [name.split(",")[0].split(" (")[0] for name in (row.name for row in report.criteria)]
    assert kinds == [
        "object error / copying", "tool error / copying", "done precision on rollouts", "done recall on rollouts",
        "done precision", "done recall", "SFT policy: imagined 2/8 - real 2/8 success",
    ]
    assert report.outcome == "failed" and report.episodes == 4 and "SFT" in report.undecided[-1]
    assert accept_model(CONFIG, model, policy, (2, 8), (2, 8), folder).to_dict() == report.to_dict()

    video = make_stepped_folder(tmp_path / "video_model")
    own = accept_model(CONFIG, model, policy, (2, 8), (2, 8), folder, video_model_dir=video)
    assert len(own.criteria) == 3 and own.episodes == 0
    off = CONFIG.with_values(acceptance=CONFIG.acceptance.with_values(clone_episodes=0))
    assert len(accept_model(off, model, policy, (2, 8), (2, 8), folder).criteria) == 5
    smaller = CONFIG.with_values(data=CONFIG.data.with_values(behaviours={"random": 1.0}))
    with pytest.raises(ValueError, match="was begun with behaviours"):
        accept_model(smaller, model, policy, (2, 8), (2, 8), folder)


def test_a_model_without_held_out_metrics_is_said_to_be_unjudged(tmp_path: Path) -> None:
    found = acceptance_when_made(make_model_folder(tmp_path / "model", CONFIG), CONFIG)
    assert found == "not judged: the model's manifest holds no metrics of held-out episodes of push_cube"
