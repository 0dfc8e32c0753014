"""The contract of core.types.Environment, kept by the simulator, the imagined environment and the benchmark's: where
the tool only moves, and where it turns and grasps in the procedural scenes, too; and by environments of somebody
else's: an arm of a file, and one of Gymnasium."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from drawn_pendulum import SETTINGS as PENDULUM
from model_folders import make_model_folder

from benchmarks.speed.noop_environment import NoopEnvironment
from examples import own_environment
from wm_nodes.config.load import load_config, preset_names
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.specs import SOURCE_REAL
from wm_nodes.core.types import Environment, FloatArray, Observation, StepResult
from wm_nodes.environments.batch import EnvironmentBatch, Frame
from wm_nodes.environments.maniskill.spec import simulation_spec
from wm_nodes.environments.registry import make_environment
from wm_nodes.world_model import ImaginedEnvironment, WorldModels, load_model_folder

N, LIMIT = 2, 3
SEEDS = np.array([11, 12], np.uint64)
Make = Callable[[int], Environment]


def config_of(task: str) -> RunConfig:
    base = load_config("smoke", {"task": task})
    return base.model_copy(update={"simulation": base.simulation.model_copy(update={"max_episode_steps": LIMIT})})


OWN = {
    "pendulum": {**PENDULUM, "gymnasium.kwargs": {"max_episode_steps": LIMIT}},
    **{preset: {"gymnasium.kwargs": {"max_episode_steps": LIMIT}} for preset in ("fetch_reach", "fetch_push")},
    "push_t": {"gymnasium.kwargs": load_config("push_t").gymnasium.kwargs | {"max_episode_steps": LIMIT}},
}
NEEDS = {"fetch_reach": "gymnasium_robotics", "fetch_push": "gymnasium_robotics", "push_t": "gym_pusht"}
CONFIGS = {"": config_of("push_cube"), " of poses": config_of("push")}


class RealArm(own_environment.Arm):
    """Nobody can put it back by a number."""

    _resets = 0

    def reset(self, seed: int) -> Frame:
        self._resets += 1
        self._joints = np.full(6, -0.5 - 0.01 * self._resets)
        return self.step(np.zeros(6, np.float32))


def make_real_arms(seed: int) -> EnvironmentBatch:
    spec = replace(own_environment.SPEC, max_episode_steps=LIMIT)
    return EnvironmentBatch(spec, [RealArm() for _ in range(N)], seed)


def make_simulator(config: RunConfig, seed: int) -> Environment:
    from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment

    return ManiSkillEnvironment(config.task, config.simulation, num_envs=N, seed=seed)


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, WorldModels]:
    folder = tmp_path_factory.mktemp("model")
    made = {kind: make_model_folder(folder / config.task, config) for kind, config in CONFIGS.items()}
    return {kind: load_model_folder(path) for kind, path in made.items()}


@pytest.fixture(
    params=[*(f"{name}{kind}" for kind in CONFIGS for name in ("maniskill", "imagined", "still")), "arm", *OWN]
)
def make(request: pytest.FixtureRequest, models: dict[str, WorldModels]) -> Iterator[Make]:
    """Builds the environment under test from a root seed; what it built is closed."""
    built: list[Environment] = []
    name, _, rest = request.param.partition(" ")
    kind = f" {rest}" if f" {rest}" in CONFIGS else ""
    config = CONFIGS[kind]
    spec = simulation_spec(config.task, config.simulation, N)

    def build(seed: int) -> Environment:
        environment: Environment
        if name == "arm":
            environment = make_real_arms(seed)
        elif name in OWN:
            if name in NEEDS and find_spec(NEEDS[name]) is None:
                pytest.skip(f"{name} needs {NEEDS[name]}, see requirements/gym.txt")
            settings = load_config(name if name in preset_names() else "smoke", OWN[name])
            environment = make_environment(settings, settings.environment.factory, num_envs=N, seed=seed)
        elif name == "maniskill":
            environment = make_simulator(config, seed)
        elif name == "imagined":
            rng = numpy_stream(0, "contract")
            images = rng.integers(0, 256, (5, spec.height, spec.width, 3), np.uint8)
            states = rng.uniform(0.5, 0.7, (5, spec.state_dim)).astype(np.float32)
            reward = config.reward.model_copy(update={"success_threshold": 1.0, "uncertainty_limit": 0.0})
            environment = ImaginedEnvironment(models[kind], spec, (images, states), reward, num_envs=N, seed=seed)
        else:
            environment = NoopEnvironment(spec)
        built.append(environment)
        return environment

    yield build
    for environment in built:
        environment.close()


def ends(environment: Environment) -> bool:
    """Whether episodes end; the benchmark's never do."""
    return not isinstance(environment, NoopEnvironment)


def takes_seeds(environment: Environment) -> bool:
    """Whether a reset's seed decides what it shows."""
    return environment.spec.source != SOURCE_REAL


def actions(step: int, environment: Environment) -> FloatArray:
    return numpy_stream(step, "actions").uniform(-0.3, 0.3, (N, environment.spec.action_dim)).astype(np.float32)


def assert_observation(observation: Observation, environment: Environment) -> None:
    spec = environment.spec
    found = {name: (value.dtype, value.shape) for name, value in vars(observation).items()}
    assert found == {
        "image": (np.uint8, (N, spec.height, spec.width, 3)), "state": (np.float32, (N, spec.state_dim)),
        "episode_id": (np.uint64, (N,)), "episode_step": (np.uint32, (N,)),
    }
    assert np.isfinite(observation.state).all()


def assert_equal(first: Observation, second: Observation, rows: slice = slice(None)) -> None:
    np.testing.assert_array_equal(first.image[rows], second.image[rows])
    np.testing.assert_array_equal(first.state[rows], second.state[rows])
    np.testing.assert_array_equal(first.episode_step[rows], second.episode_step[rows])


def run_to_the_limit(environment: Environment) -> list[StepResult]:
    return [environment.step(actions(step, environment)) for step in range(LIMIT)]


def test_shapes_and_types_are_those_of_the_spec(make: Make) -> None:
    environment = make(0)
    assert environment.spec.num_envs == N
    assert_observation(environment.reset(), environment)
    result = environment.step(actions(0, environment))
    assert_observation(result.observation, environment)
    for flag in (result.terminated, result.truncated, result.valid):
        assert (flag.dtype, flag.shape) == (np.bool_, (N,))
    for number in (result.success_probability, result.uncertainty):
        assert (number.dtype, number.shape) == (np.float32, (N,))
    assert (result.success_probability >= 0).all() and (result.success_probability <= 1).all()
    assert (result.uncertainty >= 0).all()
    assert result.ground_truth.dtype == np.float32
    assert result.ground_truth.shape == (N, environment.spec.ground_truth_dim)
    goals = environment.goals()
    if goals is not None:
        spec = environment.spec
        assert (goals[0].dtype, goals[0].shape) == (np.uint8, (N, spec.height, spec.width, 3))
        assert (goals[1].dtype, goals[1].shape) == (np.bool_, (N,))


def test_episode_ids_are_never_used_again_and_grow(make: Make) -> None:
    environment = make(0)
    first = environment.reset().episode_id
    second = environment.reset().episode_id
    third = environment.reset(mask=np.array([False, True])).episode_id
    assert first.min() > 0 and first.max() < second.min() and len({*first, *second, third[1]}) == 2 * N + 1
    assert third[0] == second[0] and third[1] > second.max()
    np.testing.assert_array_equal(environment.step(actions(0, environment)).observation.episode_id, third)


def test_the_step_counter_is_0_after_a_reset_and_counts_the_steps_made(make: Make) -> None:
    environment = make(0)
    assert not environment.reset().episode_step.any()
    assert [int(r.observation.episode_step[0]) for r in run_to_the_limit(environment)] == [1, 2, 3]


def test_a_reset_by_mask_leaves_the_others_where_they_are(make: Make) -> None:
    environment = make(0)
    environment.reset(seeds=SEEDS)
    before = environment.step(actions(0, environment)).observation
    after = environment.reset(mask=np.array([False, True]), seeds=SEEDS)
    assert_equal(before, after, slice(0, 1))
    assert after.episode_step.tolist() == [1, 0]
    if takes_seeds(environment):
        assert_equal(environment.reset(seeds=SEEDS), after, slice(1, 2))


def test_an_ended_environment_stays_put_and_is_not_valid_until_its_reset(make: Make) -> None:
    environment = make(0)
    if not ends(environment):
        pytest.skip("its episodes never end")
    environment.reset(seeds=SEEDS)
    results = run_to_the_limit(environment)
    assert all(result.valid.all() and not result.truncated.any() for result in results[:-1])
    assert (results[-1].terminated ^ results[-1].truncated).all()
    late = environment.step(actions(9, environment))
    assert not (late.valid | late.terminated | late.truncated).any()
    assert_equal(late.observation, results[-1].observation)
    environment.reset(mask=np.array([True, False]))
    assert environment.step(actions(0, environment)).valid.tolist() == [True, False]


def test_one_root_seed_gives_one_run_and_an_observation_is_not_written_later(make: Make) -> None:
    first, second = make(5), make(5)
    shown = first.reset()
    assert_equal(shown, second.reset())
    kept = replace(shown, **{name: value.copy() for name, value in vars(shown).items()})
    for step in range(2):
        mine, other = first.step(actions(step, first)), second.step(actions(step, second))
        assert_equal(mine.observation, other.observation)
        np.testing.assert_array_equal(mine.success_probability, other.success_probability)
    assert_equal(shown, kept)


def wrong_actions(size: int) -> tuple[tuple[FloatArray, str], ...]:
    """And what the refusal says. size: A."""
    return (
        (np.zeros((N + 1, size), np.float32), rf"shape \(2, {size}\).*\(3, {size}\)"),
        (np.zeros((N, size + 1), np.float32), rf"shape \(2, {size}\).*\(2, {size + 1}\)"),
        (np.full((N, size), np.nan, np.float32), "finite.*nan"),
        (np.full((N, size), 1.5, np.float32), r"\[-1, 1\].*1\.5"),
    )


def test_a_wrong_action_is_refused_by_value_and_changes_nothing(make: Make) -> None:
    environment, untouched = make(0), make(0)
    environment.reset(seeds=SEEDS)
    untouched.reset(seeds=SEEDS)
    for wrong, text in wrong_actions(environment.spec.action_dim):
        with pytest.raises(ValueError, match=text):
            environment.step(wrong)
    action = actions(0, environment)
    assert_equal(environment.step(action).observation, untouched.step(action).observation)
