"""Measure normal ranges on recordings in which nothing is wrong: as they are, decoded, imagined, harmlessly changed."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import cv2
import numpy as np

from wm_nodes.config.tasks import get_task, has_rule, part_of, same_scene, success, task_names
from wm_nodes.core.action_spaces import tool_columns
from wm_nodes.core.progress import tqdm
from wm_nodes.core.seeding import numpy_stream
from wm_nodes.core.types import Episode, FloatArray, UInt8Array
from wm_nodes.environments.object_reader import ObjectReader
from wm_nodes.judge.one_class import imagination, pictures
from wm_nodes.judge.one_class.ranges import NormalRanges, done_threshold, fit
from wm_nodes.world_model import WorldModels
from wm_nodes.world_model.positions import columns_of
from wm_nodes.world_model.validation.open_loop import imagine

SHORTEST = 4
"""Frames of a clip that ends with its success, at least."""
TOUCHING = 0.25
"""Share of the recordings in which the tool goes as low as to an object's middle, at least."""
MOVING = ("wrist",)
"""Cameras that move with the robot."""


@dataclass
class _Rows:
    """Measured clips."""

    numbers: list[dict[str, float]] = field(default_factory=list)
    """Of each clip."""
    recording: list[int] = field(default_factory=list)
    """The recording that it is a form of."""
    ends: dict[str, list[tuple[float, bool]]] = field(default_factory=dict)
    """By task the done signal at a clip's end, and whether the task is done there."""


def calibrate(
    models: WorldModels, episodes: Iterable[Episode], *, stride: int, seed: int, moving: Sequence[str] = MOVING,
    reader: ObjectReader | None = None,
) -> NormalRanges:
    """Measure the normal ranges of a world model's clips.

    Args:
        episodes: recorded ones in the model's cameras, done and undone, of the tasks that shall be judged.
        stride: steps between two frames of a clip.
        moving: names of the cameras that move; in the pictures of the others the scenery stays.
        reader: of the model's folder, as of model_numbers.

    Raises:
        ValueError: too few recordings, pictures of another size than the model's, states that lack values of its
                own, or as model_numbers.
    """
    recorded = [episode for episode in episodes if episode.num_steps >= stride * (SHORTEST - 1)]
    _check_sizes(models, recorded)
    still = tuple(name not in moving for name in models.spec.cameras)
    origin, height_m = _places(models, recorded)
    known = [task for task in models.tasks if task in task_names()]
    rows, longest, words = _Rows(), 0, set[str]().union(*(_pairs(get_task(task).instruction) for task in known))
    for index, episode in enumerate(tqdm(recorded, desc="measured", unit="episode")):
        rng = numpy_stream(seed, f"normal ranges/{index}")
        words |= _pairs(episode.instruction)
        steps = _end(episode, stride, rng)
        longest = max(longest, steps // stride + 1)
        for shown in _forms(models, episode, steps, stride, rng):
            reference = episode.images[0]
            seen = pictures.picture_numbers(shown, reference, models.spec.height, still)
            drawn, signals = imagination.model_numbers(models, shown, stride, origin, height_m, reader)
            rows.numbers.append(seen | drawn)
            rows.recording.append(index)
            for task, done in done_at(models.tasks, episode, steps).items():
                rows.ends.setdefault(task, []).append((signals[task], done))
    return NormalRanges(
        world_model=models.sha256, stride=stride, lengths=(SHORTEST - 1, 2 * longest), still=still,
        origin=(float(origin[0]), float(origin[1]), float(origin[2])), height_m=height_m, words=tuple(sorted(words)),
        done={task: done_threshold(*zip(*ends)) for task, ends in sorted(rows.ends.items())},
        **fit(rows.numbers, rows.recording, seed),
        story={"recordings": len(recorded), "clips": len(rows.numbers), "seed": seed},
    )


def _pairs(instruction: str) -> set[str]:
    """Its pairs of neighbouring words."""
    return {" ".join(pair) for pair in pairwise(words_of(instruction))}


def words_of(instruction: str) -> list[str]:
    """Its words, lower case, without articles and punctuation."""
    return [word for word in re.findall(r"[\w'-]+", instruction.lower()) if word not in ("the", "a", "an")]


def done_at(tasks: Sequence[str], episode: Episode, step: int) -> dict[str, bool]:
    """Whether each of the tasks that a recording can show is done at a frame: by its ground truth, or as recorded."""
    own = part_of(episode.task, episode.seed)
    done = {
        task: bool(success(task, episode.ground_truth[step]))
        for task in tasks if has_rule(task) and has_rule(own) and same_scene(task, own)
    }
    return {**done, own: bool(episode.success[step])} if own in tasks else done


def _end(episode: Episode, stride: int, rng: np.random.Generator) -> int:
    """Steps of the clip: half of the successful recordings end with the first success, as episodes do."""
    steps = len(episode.actions) // stride * stride
    success = np.flatnonzero(episode.success)
    if not len(success) or rng.random() < 0.5:
        return int(steps)
    return int(min(steps, max(stride * (SHORTEST - 1), -(-success[0] // stride) * stride)))


def _forms(
    models: WorldModels, episode: Episode, steps: int, stride: int, rng: np.random.Generator
) -> Sequence[UInt8Array]:
    """The recording as it is, decoded, imagined from its first frame and actions, and harmlessly changed."""
    frames = episode.images[: steps + 1 : stride]
    decoded = models.tokenizer.decode(models.tokenizer.encode(frames)).cpu().numpy()
    decoded[0] = frames[0]
    states = episode.states[None, : steps + 1, : models.spec.state_dim]  # without the values that say which task it is
    told = imagine(models.tokenizer, models.action, frames[:1], episode.actions[None, :steps], states)
    imagined = np.concatenate([frames[:1], told.frames[0, stride - 1 :: stride]])
    return frames, decoded, imagined, harmless(frames, rng)


def harmless(frames: UInt8Array, rng: np.random.Generator) -> UInt8Array:
    """One of eight changes that nobody minds: JPEG, noise, exposure, half a pixel, flicker, softness, one frame too
    many or too few, a slight cast."""
    kind = int(rng.integers(8))
    pixels = frames.astype(np.float32)
    if kind == 0:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(60, 96))]
        coded = [cv2.imencode(".jpg", frame, quality)[1] for frame in frames]
        return np.stack([cv2.imdecode(code, cv2.IMREAD_COLOR) for code in coded], dtype=np.uint8)
    if kind == 1:
        pixels = pixels + rng.normal(0, rng.uniform(1, 4), frames.shape)
    elif kind == 2:
        pixels = pixels * rng.uniform(0.8, 1.12)
    elif kind == 3:
        move = np.array([[1, 0, rng.uniform(-0.5, 0.5)], [0, 1, rng.uniform(-0.5, 0.5)]], np.float32)
        size = frames.shape[2], frames.shape[1]
        pixels = np.stack([cv2.warpAffine(f, move, size, borderMode=cv2.BORDER_REPLICATE) for f in pixels])
    elif kind == 4:
        pixels = pixels * (1 + rng.uniform(0.01, 0.04) * rng.choice([-1, 1], (len(frames), 1, 1, 1)))
    elif kind == 5:
        pixels = np.stack([cv2.GaussianBlur(frame, (0, 0), 0.5) for frame in pixels])
    elif kind == 6 and len(frames) > SHORTEST:
        at = int(rng.integers(1, len(frames) - 1))
        pixels = np.delete(pixels, at, 0) if rng.random() < 0.5 else np.insert(pixels, at, pixels[at], 0)
    elif kind == 7:
        pixels = pixels + rng.uniform(-4, 4, 3) * np.linspace(0, 1, len(frames))[:, None, None, None]
    changed: UInt8Array = np.clip(np.rint(pixels), 0, 255).astype(np.uint8)
    return changed


def _check_sizes(models: WorldModels, episodes: Sequence[Episode]) -> None:
    """Raises ValueError: pictures of another size than the model's, or states that lack values of its own."""
    size, values = (models.tokenizer.height, models.tokenizer.width), models.spec.state_dim
    for episode in episodes:
        if episode.images.shape[1:3] != size:
            height, width = episode.images.shape[1:3]
            raise ValueError(
                f"an episode has pictures of {height} x {width} px, the world model sees {size[0]} x {size[1]} px; "
                "name bags in its cameras"
            )
        if episode.states.shape[1] < values:
            raise ValueError(
                f"an episode has states of {episode.states.shape[1]} values, the world model knows {values} "
                f"({', '.join(models.spec.state_names)}); name bags of its environment, "
                "e.g. wm collect --simulation.object_state truth"
            )


def _places(models: WorldModels, episodes: Sequence[Episode]) -> tuple[FloatArray, float]:
    """Origin and height_m of NormalRanges, of the first recordings."""
    placed = [len(columns_of(models.tasks[0], thing)) for thing in ("tool", "object")]
    if models.probe is None or placed != [3, 2]:
        raise ValueError(
            "the embedded judge needs a world model that reads off its pictures where tool and object are, and that of "
            f"{', '.join(models.tasks)} does not: that takes recordings with ground truth, of a task whose file "
            "names these positions; a server judges without (--judge URL)"
        )
    tools = [models.probe.read(episode.images)[:, columns_of(models.tasks[0], "tool")] for episode in episodes[:50]]
    if not tools:
        raise ValueError("the bags hold no episode that is long enough; name more bags")
    _, placed = tool_columns(models.spec)
    lacks = [episode.states[:, placed] - tool for episode, tool in zip(episodes, tools)]
    origin = np.asarray(np.median(np.concatenate(lacks), 0), np.float32)
    return origin, float(np.quantile([tool[:, 2].min() for tool in tools], TOUCHING))
