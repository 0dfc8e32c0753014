"""Clips that the reward agent pays, in one process: the rewards of the reward_evaluator node, bit by bit."""

import hashlib
from typing import Self

from wm_nodes.config.load import judge_or_embedded
from wm_nodes.config.schema import AGENT
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.judge.agent.contract import check_one_judge, pause_reason
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.backends.factory import check_clips, for_task
from wm_nodes.judge.service import JudgeService, TrainingPaused, agent_scores, buffer_jobs
from wm_nodes.video_model import RolloutBuffer
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.video_rl.reference_reward import mix_rewards
from wm_nodes.video_rl.sampling import GroupRequest, RecordedContexts
from wm_nodes.world_model.position_probe import PositionProbe


class JudgedContexts(RecordedContexts):
    """Recorded contexts whose clips have one more score, `agent`: the reward of config.judge by its rubric. What trains
    is mixed by config.rewards, e.g. {agent: 1.0, outcome: 0.5}. Use it in a `with`, which ends the judge.

    verdicts: of the last buffer, a row per clip; () where `agent` has no weight, and nothing was judged.

    Args:
        fps: clip frames per second, see judge.service.clip_fps.

    Raises:
        ValueError: the judge cannot judge such clips; as JudgeService.
    """

    def __init__(
        self, folder: VideoFolder, contexts: Clips, config: VideoRlConfig, probe: PositionProbe, fps: float
    ) -> None:
        super().__init__(folder, contexts, config, probe)
        self.fps, self.verdicts = fps, tuple[Verdict, ...]()
        self._judge = open_judge(config, contexts, fps) if config.rewards.get(AGENT) else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._judge is not None:
            self._judge.close()

    def score(self, request: GroupRequest, clips: RolloutBuffer) -> RolloutBuffer:
        """As RecordedContexts.score; a clip without a verdict does not train. Raises TrainingPaused: too many of them.
        """
        if self._judge is None:
            return super().score(request, clips)
        frames, references = self.folder.codec.decode(clips.rollout.latents), self.references(request)
        given = self.folder.clip["num_conditioning"]
        sha256 = hashlib.sha256(clips.to_bytes()).hexdigest()
        jobs = buffer_jobs(frames, references, sha256, self.config, given=given, fps=self.fps)
        self.verdicts = tuple(self._judge.judge(jobs, round_number=clips.iteration))
        check_one_judge(self.verdicts, clips.group_ids.tolist())
        if reason := pause_reason(self.verdicts):
            raise TrainingPaused(reason)
        scores = self.scores(request, frames) | agent_scores(self.verdicts)
        return clips.with_rewards({**scores, "total": mix_rewards(scores, self.config.rewards)})


def open_judge(config: VideoRlConfig, clips: Clips, fps: float) -> JudgeService:
    """The judge of such clips that the reward_evaluator node would ask; close it in the end. Raises ValueError."""
    settings, models = for_task(judge_or_embedded(config.judge), config.task), shipped_model(config.task)
    check_clips(settings, tuple(clips.frames.shape[1:]), fps)
    return JudgeService(settings, seed=config.seed, model_dir=models, device=config.device)
