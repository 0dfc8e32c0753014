"""The pictures of a run's report: the same actions in the simulator and in the world model, and the training's course.

Shapes: T steps, H W 3 image.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wm_nodes.config.schema import RunConfig
from wm_nodes.config.tasks import success_or_recorded
from wm_nodes.core.specs import SOURCE_SIMULATOR
from wm_nodes.core.types import Environment, Episode, FloatArray, UInt8Array
from wm_nodes.environments.registry import GYMNASIUM, is_simulated, make_environment
from wm_nodes.policy_rl.factories import models_of
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.recording.episode_arrays import EpisodeArrays, stack_episodes
from wm_nodes.reports.curves import curves
from wm_nodes.reports.film_strip import film_strip, moving_picture
from wm_nodes.reports.html import Picture
from wm_nodes.training.metrics import FILE_NAME
from wm_nodes.world_model import WorldModels
from wm_nodes.world_model.text import imagine_goals
from wm_nodes.world_model.validation.open_loop import imagine_episodes

NUM_STRIPS = 2
MOVING = "real_and_imagined.gif"


@dataclass(frozen=True)
class SideBySide:
    """One episode twice: as it was, and imagined under the same actions from the same first frame."""

    real: UInt8Array
    """uint8 (T + 1, H, W, 3)."""
    imagined: UInt8Array
    """uint8 (T + 1, H, W, 3), the same actions from the same first frame."""
    goal: UInt8Array | None
    """uint8 (H, W, 3), imagined; None without a text model."""
    real_done: int
    """First real frame that shows success, or -1."""
    imagined_done: int
    """First imagined frame whose done signal is above reward.success_threshold, or -1."""
    signals: FloatArray
    """float32 (T,), the done signal of imagined frames 1..T."""

    @property
    def rows(self) -> dict[str, UInt8Array]:
        """As a film strip shows them."""
        return {"real": self.real, "imagined": self.imagined}

    @property
    def done(self) -> dict[str, int]:
        """Label to the first frame that is done, of rows that have one."""
        first = {"real": self.real_done, "imagined": self.imagined_done}
        return {name: step for name, step in first.items() if step >= 0}


def write_pictures(
    run_dir: Path, config: RunConfig, model_dir: Path, policy: ImagePolicy, first_seed: int
) -> list[Picture]:
    """Play NUM_STRIPS episodes of the policy where it is measured, imagine the same actions, and draw both; and the
    curves. On a robot, or whatever else an environment of one's own is, nothing is played.

    Writes PNGs and a GIF to <run_dir>/pictures.
    """
    folder, pictures = run_dir / "pictures", list[Picture]()
    if is_simulated(config) or config.evaluation.environment == GYMNASIUM:
        pictures += _strips(folder, config, model_dir, policy, first_seed)
    drawn = curves(run_dir / FILE_NAME, folder / "curves.png")
    if drawn is not None:
        pictures.append(Picture("Training", "In the world model, by policy update.", drawn))
    return pictures


def _strips(
    folder: Path, config: RunConfig, model_dir: Path, policy: ImagePolicy, first_seed: int
) -> Iterator[Picture]:
    environment = make_environment(config, config.evaluation.environment, num_envs=1, seed=config.seed)
    try:
        episodes = [play(environment, policy, first_seed + i) for i in range(NUM_STRIPS)]
    finally:
        environment.close()
    pairs = side_by_side(models_of(Path(model_dir), config.device), episodes, config)
    moving = Picture("Real and imagined", "The episodes below, as they pass.", folder / MOVING)
    moving_picture([pair.rows for pair in pairs], moving.path, marks=[pair.done for pair in pairs])
    yield moving
    for index, pair in enumerate(pairs):
        path = folder / f"film_strip_{index}.png"
        rows = pair.rows | ({} if pair.goal is None else {"goal": pair.goal[None]})
        film_strip(rows, path, marks=pair.done)
        yield Picture(f"Real and imagined, episode {index + 1}", describe(pair, first_seed + index), path)


def play(environment: Environment, policy: ImagePolicy, seed: int) -> Episode:
    """One episode without action noise; `environment` has one slot."""
    observation = environment.reset(None, np.array([seed], np.uint64))
    images, states, actions, said = [observation.image[0]], [observation.state[0]], list[FloatArray](), [False]
    truths = [getattr(environment, "ground_truth", np.zeros((1, 0), np.float32))[0]]
    while True:
        action = policy.act(observation.image, observation.state).actions
        result = environment.step(action)
        observation = result.observation
        actions.append(action[0])
        images.append(observation.image[0])
        states.append(observation.state[0])
        truths.append(result.ground_truth[0])
        said.append(bool(result.success_probability[0] > 0.5))
        if result.ended[0]:
            break
    spec, truth = environment.spec, np.stack(truths)
    return Episode(
        images=np.stack(images), states=np.stack(states), actions=np.stack(actions), ground_truth=truth,
        success=success_or_recorded(spec.task, truth, np.array(said)),
        rewards=np.full(len(actions), np.nan, np.float32), terminated=bool(result.terminated[0]),
        truncated=bool(result.truncated[0]), task=spec.task,
        instruction=getattr(environment, "instructions", (spec.instruction,))[0], behaviour="policy", seed=seed,
        episode_id=seed, source=SOURCE_SIMULATOR,
    )


def side_by_side(models: WorldModels, episodes: list[Episode], config: RunConfig) -> list[SideBySide]:
    """Imagine the actions of real episodes, and the goal of each first frame where all instructions are known words."""
    arrays: EpisodeArrays = stack_episodes(episodes, models.tasks)
    tasks = [models.task_index(task) for task in arrays.recorded_tasks]
    imagined = imagine_episodes(models.tokenizer, models.action, arrays)
    goals = None
    if models.text is not None and all(map(models.text.knows, arrays.instructions)):
        goals = imagine_goals(
            models.text, models.tokenizer, arrays.images[:, 0], arrays.instructions, tasks,
            horizon=models.spec.max_episode_steps, threshold=config.reward.goal_threshold,
        ).goals
    pairs = []
    for row, episode in enumerate(episodes):
        signals = imagined.signals[row, : episode.num_steps, tasks[row]]
        frames = np.concatenate([episode.images[:1], imagined.frames[row, : episode.num_steps]])
        above = np.concatenate([[False], signals > config.reward.success_threshold])
        goal = None if goals is None else goals[row]
        pairs.append(SideBySide(episode.images, frames, goal, first_true(episode.success), first_true(above), signals))
    return pairs


def describe(pair: SideBySide, seed: int) -> str:
    """The caption of one strip."""
    real = f"done at step {pair.real_done}" if pair.real_done >= 0 else "not done"
    imagined = f"done at step {pair.imagined_done}" if pair.imagined_done >= 0 else "not done"
    goal = "" if pair.goal is None else " Goal: what the text model imagines for the instruction."
    return (
        f"Seed {seed}. Real: the trained policy in the simulator, {real}. Imagined: the same actions in the model "
        f"from the same first frame, {imagined} (done signal up to {pair.signals.max():.2f}). Green frame: done.{goal}"
    )


def first_true(values: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> int:
    return int(values.argmax()) if values.any() else -1
