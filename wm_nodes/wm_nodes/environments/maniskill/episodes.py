"""Act one episode in the simulator and return it with its ground truth."""

import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from wm_nodes.config.tasks import simulator_part, success
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.tool_control import moves_pose
from wm_nodes.core.types import RECOVERY, TAKEN_OVER, Episode, FloatArray, Observation
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.environments.maniskill.planner import DemonstrationPlanner, PlanningError, follow, track
from wm_nodes.environments.maniskill.pose_behaviours import PLANNED, vary

Act = Callable[[Observation, FloatArray], FloatArray]
"""(observation of one slot, ground truth (P,)) -> action (A,); a policy ignores the ground truth."""
EXTREME, HOLD_STEPS = "extreme", 4
"""The behaviour of every task that no world model is trained on: full-scale actions in random directions, each held for
so many steps. A single one would hardly move the tool before the next takes it back."""

SCATTERED = "scattered"
"""The behaviour of episodes for what reads places off pictures: the tool wanders, and before every step the object is
put elsewhere. Of tasks in the procedural scenes; no dynamics is to be learned from it."""


def scripted_episode(env: ManiSkillEnvironment, behaviour: str, seed: int, episode_id: int) -> Episode:
    """One episode of a scripted behaviour; everything random follows from `seed`."""
    if behaviour == SCATTERED and not hasattr(env.scene, "scatter"):
        raise ValueError(f"task {env.spec.task} has no procedural scene whose object can be put elsewhere; leave "
                         f"behaviour {SCATTERED} out, and set data.num_scattered to 0")
    env.reset(seeds=np.array([seed], np.uint64))
    truth, rng = env.ground_truth[0], numpy_stream(seed, "behaviour")
    script = simulator_part(env.spec.task).script
    scripted = (
        extreme_actions(rng, env.spec.action_dim) if behaviour == EXTREME
        else script("random" if behaviour == SCATTERED else behaviour, truth, rng, env.spec.action_scale[0])
    )

    def act(observation: Observation, truth_now: FloatArray) -> FloatArray:
        if behaviour == SCATTERED:
            env.scene.scatter(rng)
        return scripted(truth_now, observation.state[0, : env.spec.commanded_dim])

    return record_episode(env, act, behaviour, seed, episode_id)


def recovered_episode(env: ManiSkillEnvironment, begin: Act, seed: int, episode_id: int) -> Episode:
    """An episode of a freshly reset environment that `begin` acts, and the task's script, as after a reset, from a step
    on that follows from `seed`."""
    rng = numpy_stream(seed, RECOVERY)
    first, script = int(rng.integers(1, max(2, env.spec.max_episode_steps // 2))), simulator_part(env.spec.task).script
    scripted: Callable[[FloatArray, FloatArray], FloatArray] | None = None

    def act(observation: Observation, truth: FloatArray) -> FloatArray:
        nonlocal scripted
        if observation.episode_step[0] < first:
            return begin(observation, truth)
        if scripted is None:
            scripted = script("expert", truth, rng, env.spec.action_scale[0])
        return scripted(truth, observation.state[0, : env.spec.commanded_dim])

    episode = record_episode(env, act, RECOVERY, seed, episode_id)
    return replace(episode, extra={**episode.extra, TAKEN_OVER: first})


def extreme_actions(rng: np.random.Generator, action_dim: int) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Return act(ground truth, state) -> action (A,) of the behaviour EXTREME."""
    action, left = np.zeros(action_dim, np.float32), 0

    def act(_truth: FloatArray, _state: FloatArray) -> FloatArray:
        nonlocal action, left
        if not left:
            action, left = rng.choice(np.array([-1.0, 1.0], np.float32), action_dim), HOLD_STEPS
        left -= 1
        return action

    return act


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
        if result.ended[0]:
            break
    succeeded = success(env.spec.task, np.stack(truths))
    shown = env.shown_scenes[0]
    return Episode(
        images=np.stack(images), states=np.stack(states), actions=np.stack(actions), ground_truth=np.stack(truths),
        success=succeeded, rewards=(succeeded[1:] & ~succeeded[:-1]).astype(np.float32),
        terminated=bool(result.terminated[0]), truncated=bool(result.truncated[0]), task=env.spec.task,
        instruction=env.instructions[0], behaviour=behaviour, seed=seed, episode_id=episode_id, source=env.spec.source,
        policy_version=policy_version, extra={"scene": shown.name} if shown else {},
    )


def planned_episode(
    env: ManiSkillEnvironment, planner: DemonstrationPlanner, seed: int, episode_id: int, behaviour: str = "expert"
) -> Episode:
    """One MPLib demonstration. behaviour: one of planned_behaviours. Raises PlanningError where no path is found."""
    env.reset(seeds=np.array([seed], np.uint64))
    if moves_pose(env.spec):
        waypoints = simulator_part(env.spec.task).waypoints(env.ground_truth[0])
        varied = vary(behaviour, waypoints, planner.start(), numpy_stream(seed, "behaviour"))
        path_follower = track(planner.pose_path(varied), env.spec)
    else:
        path_follower = follow(planner.tool_path(), env.spec.action_scale[0])

    def act(observation: Observation, truth: FloatArray) -> FloatArray:
        return path_follower(observation.state[0, : env.spec.commanded_dim])

    return record_episode(env, act, behaviour, seed, episode_id)


def planned_or_scripted_episode(
    env: ManiSkillEnvironment, planner: DemonstrationPlanner, behaviour: str, seed: int, episode_id: int
) -> Episode:
    """One episode of a behaviour. Without a plan, the script follows the same waypoints: a warning says so, and
    Episode.extra["planner"]."""
    if behaviour not in planned_behaviours(env.spec):
        return scripted_episode(env, behaviour, seed, episode_id)
    try:
        return planned_episode(env, planner, seed, episode_id, behaviour)
    except PlanningError as error:
        shown = env.shown_scenes[0]
        where = f"seed {seed}, {f'scene {shown.name}, ' if shown else ''}task {env.spec.task}, {behaviour}"
        print(f"warning: {where}: {error}; its waypoints are followed without a plan", file=sys.stderr, flush=True)
        episode = scripted_episode(env, behaviour, seed, episode_id)
        return replace(episode, extra={**episode.extra, "planner": str(error)})


def planned_behaviours(spec: EnvironmentSpec) -> tuple[str, ...]:
    """The behaviours that MPLib plans in a task; the others are scripted alone."""
    return PLANNED if moves_pose(spec) else PLANNED[:1]
