"""A real robot as an environment: when it holds, and how."""

from dataclasses import replace

import numpy as np
import pytest

from examples import own_environment
from wm_nodes.core.specs import SOURCE_SIMULATOR
from wm_nodes.core.types import FloatArray
from wm_nodes.environments.batch import EnvironmentBatch, Frame

SPEC = replace(own_environment.SPEC, max_episode_steps=3)


class Told(own_environment.Arm):
    """Notes what it is told; without hold()."""

    hold = None  # type: ignore[assignment]

    def __init__(self) -> None:
        self.told = list[str]()

    def reset(self, seed: int) -> Frame:
        shown = super().reset(seed)
        self.told.clear()
        return shown

    def step(self, action: FloatArray) -> Frame:
        self.told.append(f"{action[0]:g}")
        return super().step(action)._replace(success=False)


class Holding(Told):
    def hold(self) -> None:
        self.told.append("hold")


ARMS = pytest.mark.parametrize(("arm", "held"), [(Told(), "0"), (Holding(), "hold")])


def run_to_the_limit(batch: EnvironmentBatch) -> None:
    for _ in range(SPEC.max_episode_steps):
        batch.step(np.full((batch.spec.num_envs, 6), 0.5, np.float32))


@ARMS
def test_a_robot_holds_when_its_episode_ends_and_whenever_it_is_told_to(arm: Told, held: str) -> None:
    batch = EnvironmentBatch(SPEC, [arm], 0)
    batch.reset()
    batch.hold()
    assert arm.told == [held]
    run_to_the_limit(batch)
    assert arm.told == [held, *["0.5"] * 3, held], "a hold is no step of the episode"
    batch.hold()
    assert arm.told[-2:] == [held, held]


def test_one_robot_holds_where_its_own_episode_ends_and_a_simulator_does_not() -> None:
    first, second = Holding(), Holding()
    batch = EnvironmentBatch(SPEC, [first, second], 0)
    batch.reset()
    batch.step(np.full((2, 6), 0.5, np.float32))
    batch.reset(np.array([True, False]))
    batch.step(np.full((2, 6), 0.5, np.float32))
    batch.step(np.full((2, 6), 0.5, np.float32))
    assert (first.told, second.told) == (["0.5"] * 2, [*["0.5"] * 3, "hold"])
    simulated = EnvironmentBatch(replace(SPEC, source=SOURCE_SIMULATOR), [first], 0)
    simulated.reset()
    run_to_the_limit(simulated)
    assert first.told == ["0.5"] * 3
