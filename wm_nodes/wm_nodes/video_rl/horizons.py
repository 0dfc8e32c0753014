"""How a video model does clip after clip on its own frames, and what the best clip of a group is better by.

Shapes: E contexts, n clips of a group, F frames.
"""

from dataclasses import dataclass, replace

from torch import Tensor

from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.statistics import bootstrap_mean
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.video_rl.reference_reward import mix_rewards, score_clips
from wm_nodes.video_rl.sampling import GroupRequest, RecordedContexts
from wm_nodes.world_model.position_probe import PositionProbe

DRIFT = ("tool_cm", "object_cm", "psnr_db")


@dataclass(frozen=True)
class Headroom:
    """Groups of continuations after `clips - 1` self-made clips."""

    clips: int
    """Number of the clip, from 1."""
    reward: float
    """Mean of a clip."""
    best: float
    """Mean of the best of n."""
    gain: tuple[float, float, float]
    """best - reward, mean over contexts and its 95 % bootstrap interval."""
    codec: float
    """Reward of the recording, decoded from its latents."""

    @property
    def share(self) -> float:
        """The part of the gap to the codec that the best of a group closes, by the upper end of its interval."""
        gap = self.codec - self.reward
        return self.gain[2] / gap if gap > 0 else 0.0


def measure_headroom(
    folder: VideoFolder, contexts: Clips, config: VideoRlConfig, probe: PositionProbe
) -> list[Headroom]:
    """Return the head-room of groups.group_size clips by the rewards of `config`, one per horizon, or only that of
    whole clips where the model makes such.

    Raises:
        ValueError: a reward that is no score against the recording.
    """
    config = config.with_values(groups=config.groups.with_values(history=0), window=config.window.with_values(
        strategy="all"
    ))
    source, n, found = RecordedContexts(folder, contexts, config, probe), config.groups.group_size, list[Headroom]()
    made, lengths = contexts.frames.shape[1] - folder.clip["num_conditioning"], folder.lengths
    for history in [None] if lengths is None else range(made // lengths.new):
        request = GroupRequest(tuple(range(len(contexts))), n, history or 0, 0, history)
        buffer = source.score(request, source.sample(request))
        single = replace(request, group_size=1)
        coded = folder.codec.decode(folder.codec.encode(source.references(single).frames))
        ceiling = mix_rewards(source.scores(single, coded), config.rewards)
        rewards = buffer.rewards["total"].view(-1, n)
        gain = bootstrap_mean((rewards.amax(1) - rewards.mean(1)).numpy(), seed=config.seed)
        reward, best, codec = (float(values.mean()) for values in (rewards, rewards.amax(1), ceiling))
        found.append(Headroom((history or 0) + 1, reward, best, gain, codec))
    return found


def horizon_scores(frames: Tensor, recorded: Clips, probe: PositionProbe, folder: VideoFolder) -> dict[str, Tensor]:
    """Score each clip of whole rollouts, uint8 (E, F, H, W, 3), by itself: DRIFT scores ending in _<clip>, from 1."""
    lengths, first, found, clip = folder.lengths, folder.clip["num_conditioning"], dict[str, Tensor](), 1
    new = lengths.new if lengths else frames.shape[1] - first
    while first < frames.shape[1]:
        count, given = min(new, frames.shape[1] - first), min(1, first)
        part = recorded.window(first - given, given + count)
        scores = score_clips(frames[:, first - given : first + count], part, probe, given)
        found |= {f"{name}_{clip}": scores[name] for name in DRIFT}
        first, clip = first + count, clip + 1
    return found
