"""The clips and scores that a run of loop 2 recorded: score them again from their pictures, train on them again.

Shapes: N clips of a buffer, F frames, H W 3 image.
"""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from wm_nodes.config.load import load_video_config, read_yaml
from wm_nodes.config.schema import AGENT
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.types import UInt8Array
from wm_nodes.recording import Bag, BagError, topics
from wm_nodes.recording.layout import Tiles
from wm_nodes.recording.messages import stamp_ns
from wm_nodes.recording.raw import PARTIAL_SUFFIX
from wm_nodes.video_model import RolloutBuffer, RolloutBufferError
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_rl.execution_reward import EXECUTION_SCORES
from wm_nodes.video_rl.reference_reward import mix_rewards
from wm_nodes.video_rl.sampling import RecordedContexts


@dataclass(frozen=True)
class RecordedClips:
    """One ClipBatch of N clips with its ClipScores."""

    iteration: int
    """Of the training."""
    policy_version: int
    """Of the weights that sampled."""
    contexts: Tensor
    """Rows of the context bags' clips, one per clip (N,)."""
    num_frames: int
    """Of a clip."""
    uri: str
    """Of the rollout buffer, in the run folder."""
    sha256: str
    """Of that file."""
    scores: Mapping[str, Tensor]
    """By name, float64 (N,), NaN where missing."""
    total: Tensor
    """What trains, float64 (N,), NaN where missing."""
    picture: UInt8Array | None
    """uint8 (N H, F W, 3), or None where not read."""
    weights: Mapping[str, float]
    """Of the scores in the total."""

    def frames(self, height: int, width: int) -> Tensor:
        """The clips, uint8 (N, F, H, W, 3), cut out of the picture.

        Raises:
            BagError: the picture is missing, or of another size.
        """
        count = len(self.contexts)
        tiles = Tiles(count, self.num_frames, height, width)
        if self.picture is None or self.picture.shape[:2] != tiles.mosaic_shape:
            size = "not in the bag" if self.picture is None else f"{self.picture.shape[:2]} px"
            raise BagError(
                f"the picture of iteration {self.iteration} is {size}; {count} clips of {self.num_frames} frames need "
                f"{tiles.mosaic_shape} px: record {topics.CLIP_IMAGES.name}, and name the context bags of that run"
            )
        cut = tiles.untile(self.picture, count * self.num_frames)
        return torch.from_numpy(np.ascontiguousarray(cut)).view(count, self.num_frames, height, width, 3)


@dataclass(frozen=True)
class Rescored:
    """A buffer scored again."""

    recorded: RecordedClips
    """What the bag holds."""
    total: Tensor
    """Of now."""
    different: tuple[str, ...]
    """Names of scores or `total` whose bits are not the recorded ones."""
    same_reward: bool
    """The total was recorded with the same rewards; else it is not compared."""
    verdicts: tuple[Mapping[str, Any], ...]
    """The agent's; () where it was not called."""
    unanswered: int
    """Clips that the agent gave no reward then, which are not compared."""


BufferJudge = Callable[[RecordedClips, Tensor, Clips], tuple[Mapping[str, Tensor], tuple[Mapping[str, Any], ...]]]
"""Judges a buffer's N clips, uint8 (N, F, H, W, 3), given the recordings of their contexts; returns scores, float64
(N,), by name, and a row per clip of its verdict."""


def read_run(run_dir: Path, overrides: dict[str, Any] | None = None) -> tuple[Path, VideoRlConfig]:
    """Return the full path of a run folder, and its settings with some overridden.

    Raises:
        ValueError: it holds no settings, or those of another kind of run.
    """
    folder = run_dir.expanduser().absolute()
    saved = folder / "config.yaml"
    if not saved.is_file():
        raise ValueError(f"{folder} holds no config.yaml; name the run folder of a train-video-model, or a bag")
    if "grpo" not in read_yaml(saved):
        raise ValueError(f"{folder} is no run of a video model; name the run folder of a train-video-model")
    return folder, load_video_config(str(saved), overrides)


def recorded_bags(run_dir: Path) -> list[Path]:
    """Return the bags of a run, one per start, oldest first; those of killed recorders by their final name.

    Raises:
        ValueError: there is none.
    """
    folders = (path for path in (run_dir / "bags").glob("*") if path.is_dir())
    bags = sorted({path.with_name(path.name.removesuffix(PARTIAL_SUFFIX)) for path in folders})
    if not bags:
        raise ValueError(f"{run_dir} holds no recorded bag; name the run folder of a train-video-model that trained")
    return bags


def recorded_episodes(run_dir: Path, part: Literal["train", "heldout"]) -> list[Path]:
    """Return the bags of simulator episodes that a run took its contexts from.

    Raises:
        ValueError: there is none.
    """
    shards = sorted((run_dir / "data" / part).glob("shard_????????"))
    if not shards:
        raise ValueError(f"{run_dir / 'data' / part} holds no episodes; name the run folder that recorded the clips")
    return shards


def read_clips(bag: Path, *, pictures: bool = False) -> Iterator[RecordedClips]:
    """Yield the scored clips of a live recording, in the order of their scores; unscored ones are left out. There is
    none where a run was stopped before its first score.

    Raises:
        BagError: an unusable bag, or scores without clips or pictures.
    """
    wanted = (topics.CLIPS, topics.CLIP_SCORES, *((topics.CLIP_IMAGES,) if pictures else ()))
    rows = {topics.absolute(topics.DEFAULT_NAMESPACE, topic): topic for topic in wanted}
    with Bag(bag) as opened:
        opened.check_types(list(rows))
        scored = opened.count(topics.absolute(topics.DEFAULT_NAMESPACE, topics.CLIP_SCORES))
        for name in rows:
            if scored and not opened.count(name):
                raise BagError(f"bag {bag} has no message on {name}; name a recorded run of train-video-model")
        clips, shown = dict[str, Any](), dict[int, UInt8Array]()
        for name, _, data in opened.messages(list(rows)):
            topic, message = rows[name], opened.decode(data, rows[name].msgtype)
            if topic is topics.CLIP_IMAGES:
                pixels = np.asarray(message.data).reshape(message.height, message.width, 3)
                shown[stamp_ns(message.header.stamp)] = pixels
            elif topic is topics.CLIPS:
                clips[message.sha256] = message
            elif (batch := clips.pop(message.buffer_sha256, None)) is not None:
                picture = shown.pop(stamp_ns(batch.header.stamp), None)
                yield _join_scores(batch, message, picture)


def rescore(recorded: RecordedClips, source: RecordedContexts, judge: BufferJudge | None = None) -> Rescored:
    """Score the pictures against the recordings of their contexts and compare with the recorded scores, bit for bit.

    Args:
        source: its rewards mix the total; where other scores have a weight than were recorded, the total is not
            compared.
        judge: called where the agent is among the rewards.

    Raises:
        BagError: no picture, or scores that cannot be computed from pictures.
        ValueError: a context that the bags do not hold.
    """
    if int(recorded.contexts.max()) >= len(source.contexts):
        raise ValueError(
            f"iteration {recorded.iteration} is of context {int(recorded.contexts.max())}, the bags hold "
            f"{len(source.contexts)}; name the folder of the run that recorded it"
        )
    asked_for = source.request(recorded.iteration, recorded.policy_version)
    request = replace(asked_for, contexts=tuple(recorded.contexts.tolist()), group_size=1)
    references, rewards = source.references(request), source.config.rewards
    frames = recorded.frames(*references.frames.shape[2:4]).to(source.folder.device)
    scores = source.scores(request, frames, recorded.scores)
    asked = {AGENT, *EXECUTION_SCORES}  # given only where they are among the rewards
    unknown, verdicts = sorted(set(recorded.scores) - set(scores) - asked), tuple[Mapping[str, Any], ...]()
    if judge is not None and rewards.get(AGENT):
        judged, verdicts = judge(recorded, frames, references)
        scores |= judged
    if unknown:
        raise BagError(f"{', '.join(unknown)} cannot be scored again from pictures; only {', '.join(scores)} can")
    total = mix_rewards(scores, rewards)
    total = torch.where(torch.isfinite(total), total, torch.nan)
    weighted, weighted_now = ({n for n, weight in weights.items() if weight} for weights in (recorded.weights, rewards))
    same_reward = weighted == weighted_now
    pairs = {name: (values, scores[name].double()) for name, values in recorded.scores.items() if name in scores}
    if same_reward:
        pairs["total"] = recorded.total, total
    answered = torch.ones(len(total), dtype=torch.bool)
    if verdicts and AGENT in recorded.scores:
        answered = torch.isfinite(recorded.scores[AGENT])
    bits = {name: [some[answered].numpy().tobytes() for some in pair] for name, pair in pairs.items()}
    different = tuple(name for name, (old, new) in bits.items() if old != new)
    return Rescored(recorded, total, different, same_reward, verdicts, int((~answered).sum()))


def recorded_buffer(
    run_dir: Path, recorded: RecordedClips, rewards: Mapping[str, float] | None = None
) -> RolloutBuffer:
    """Return the saved rollout buffer with its recorded scores. rewards: weights to mix them; None: the recorded total.

    Raises:
        RolloutBufferError: the buffer was not kept, or is another one; names the remedy.
    """
    path = run_dir / recorded.uri
    if not path.is_file():
        raise RolloutBufferError(
            f"{path} is gone: the run kept only its newest rollout buffers, and training again needs all of them; "
            "start a run with --keep-buffers as large as its iterations"
        )
    data = path.read_bytes()
    sha256 = hashlib.sha256(data).hexdigest()
    if sha256 != recorded.sha256:
        raise RolloutBufferError(
            f"{path} has sha256 {sha256[:12]}, the bag says {recorded.sha256[:12]}: it is damaged or of another run; "
            "restore it, or train again from another run"
        )
    total = recorded.total if rewards is None else mix_rewards(recorded.scores, rewards)
    return RolloutBuffer.from_bytes(data).with_rewards({**recorded.scores, "total": total})


def trained_clips(bags: Sequence[Path], iterations: int) -> list[RecordedClips]:
    """Return the clips of iterations 0, 1, ... without pictures; the later ones where a resumed run sampled one twice.

    Raises:
        BagError: an unusable bag, or an iteration that none of them holds.
    """
    clips = {recorded.iteration: recorded for bag in bags for recorded in read_clips(bag)}
    missing = [iteration for iteration in range(iterations) if iteration not in clips]
    if missing:
        raise BagError(
            f"{len(missing)} of {iterations} iterations, from {missing[0]} on, have no scored clips in "
            f"{', '.join(map(str, bags)) or 'any bag'}; train again from a run that was recorded to its end"
        )
    return [clips[iteration] for iteration in range(iterations)]


def _join_scores(batch: Any, scores: Any, picture: UInt8Array | None) -> RecordedClips:
    count = int(scores.num_clips)
    values = torch.from_numpy(np.array(scores.values, np.float64)).view(len(scores.names), count)
    valid = torch.from_numpy(np.array(scores.valid, np.uint8)).bool()
    total = torch.from_numpy(np.array(scores.total, np.float64))
    contexts = torch.from_numpy(np.array(batch.contexts, np.int64)).repeat_interleave(int(batch.group_size))
    return RecordedClips(
        int(batch.iteration), int(batch.policy_version), contexts, int(batch.num_frames), batch.buffer_uri,
        batch.sha256, dict(zip(scores.names, values, strict=True)), torch.where(valid, total, torch.nan), picture,
        dict(zip(scores.names, map(float, scores.weights), strict=True)),
    )
