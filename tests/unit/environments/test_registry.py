"""Environments by name: a real robot is made once."""

import pytest

from examples import own_environment
from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.environments.batch import EnvironmentBatch
from wm_nodes.environments.registry import make_environment


class Opened(own_environment.Arm):
    is_open = True

    def close(self) -> None:
        self.is_open = False


made = list[Opened]()


def make_several(config: RunConfig, num_envs: int, seed: int) -> EnvironmentBatch:
    made[:] = [Opened() for _ in range(num_envs)]
    return EnvironmentBatch(own_environment.SPEC, made, seed)


@pytest.fixture
def config() -> RunConfig:
    return load_config("smoke", {"task": ""})


def test_of_a_real_robot_one_is_made_however_many_are_asked_for(config: RunConfig) -> None:
    assert make_environment(config, "examples.own_environment:make", num_envs=64, seed=0).spec.num_envs == 1


def test_a_real_robot_that_is_made_several_times_is_refused_with_the_remedy_and_closed(config: RunConfig) -> None:
    name = f"{__name__}:make_several"
    with pytest.raises(ValueError, match=r"num_envs is 4, and lab/six_joint_arm is a real robot.* make one.*:=1"):
        make_environment(config, name, num_envs=4, seed=0)
    assert len(made) == 4 and not any(arm.is_open for arm in made)
    assert make_environment(config, name, num_envs=1, seed=0).spec.num_envs == 1
