"""Act one episode in the simulator and return it with its ground truth."""

from collections.abc import Callable

import numpy as np

from wm_nodes.config.tasks import get_task, success
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.types import Episode, FloatArray, Observation
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.maniskill.planner import DemonstrationPlanner, follow

Act = Callable[[Observation, FloatArray], FloatArray]
"""(observation of one slot, ground truth (P,)) -> action (A,); a policy ignores the ground truth."""


def scripted_episode(env: ManiSkillEnvironment, behaviour: str, seed: int, episode_id: int) -> Episode:
    """One episode of a scripted behaviour; everything random follows from `seed`."""
    env.reset(seeds=np.array([seed], np.uint64))
    truth = env.ground_truth[0]
    script = get_task(env.spec.task).script
    scripted = script(behaviour, truth, numpy_stream(seed, "behaviour"), env.spec.action_scale[0])

    def act(observation: Observation, truth_now: FloatArray) -> FloatArray:
        return scripted(truth_now, observation.state[0])

    return record_episode(env, act, behaviour, seed, episode_id)


def record_episode(
    env: ManiSkillEnvironment, act: Act, behaviour: str, seed: int, episode_id: int, policy_version: int = 0
) -> Episode:
    """Step a freshly reset one-slot environment to its end. Rewards are the simulator's sparse success."""
    observation = env.current()
    images, states, truths = [observation.image[0]], [observation.state[0]], [env.ground_truth[0]]
    actions = []
    while True:
        action = act(env.current(), truths[-1])
        result = env.step(action[None])
        actions.append(action)
        images.append(result.observation.image[0])
        states.append(result.observation.state[0])
        truths.append(result.ground_truth[0])
        if result.terminated[0] or result.truncated[0]:
            break
    succeeded = success(env.spec.task, np.stack(truths))
    return Episode(
        images=np.stack(images), states=np.stack(states), actions=np.stack(actions), ground_truth=np.stack(truths),
        success=succeeded, rewards=(succeeded[1:] & ~succeeded[:-1]).astype(np.float32),
        terminated=bool(result.terminated[0]), truncated=bool(result.truncated[0]), task=env.spec.task,
        instruction=env.instructions[0], behaviour=behaviour, seed=seed, episode_id=episode_id, source=env.spec.source,
        policy_version=policy_version,
    )


def planned_episode(env: ManiSkillEnvironment, planner: DemonstrationPlanner, seed: int, episode_id: int) -> Episode:
    """One MPLib demonstration (behaviour `expert`). Raises PlanningError where no path is found."""
    env.reset(seeds=np.array([seed], np.uint64))
    track = follow(planner.tool_path(), env.spec.action_scale[0])

    def act(observation: Observation, truth: FloatArray) -> FloatArray:
        return track(observation.state[0])

    return record_episode(env, act, "expert", seed, episode_id)
