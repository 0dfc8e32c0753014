"""reward_evaluator of loop 2: judges the clips of a rollout buffer against the recordings of their contexts, and by the
reward agent or an action world model where they are among the weighed rewards."""

import hashlib
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from wm_msgs.action import EvaluateClips
from wm_msgs.msg import ClipScores, ClipVerdict
from wm_nodes.config.load import judge_or_embedded, load_video_config
from wm_nodes.config.schema import AGENT
from wm_nodes.core.device import compute_device
from wm_nodes.core.named_files import BUFFER, NamedFiles
from wm_nodes.judge.agent.contract import check_one_judge
from wm_nodes.judge.agent.types import GATED
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.backends.factory import check_clips, for_task
from wm_nodes.judge.service import agent_scores, buffer_jobs, clip_fps
from wm_nodes.nodes.judge import services
from wm_nodes.nodes.judge.services import JudgeServices, deadline_of
from wm_nodes.ros import convert
from wm_nodes.ros.actions import WorkerAction
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param, named_files
from wm_nodes.ros.spin import run_node
from wm_nodes.ros.worker import Work
from wm_nodes.video_model import RolloutBuffer, RolloutBufferError
from wm_nodes.video_model.clips import Clips, load_clips
from wm_nodes.video_model.folder import load_video_folder
from wm_nodes.video_rl.reference_reward import load_probe, mix_rewards
from wm_nodes.video_rl.sampling import GroupRequest, RecordedContexts

PARAMS = (
    Param("video_model_dir", "", "Folder of the video model; its codec decodes the clips", read_only=True),
    Param("context_bags", [""], "Bags of the contexts, the same and in the same order as the video_model node's",
          read_only=True),
    Param("model_dir", "", "World-model folder; its position probe reads the pictures", read_only=True),
    *services.PARAMS,
)

REWARD_NAME = "reference"


class ClipEvaluatorNode(ManagedNode):
    """Action clips/evaluate; publishes clips/scores. With the agent also what JudgeServices has."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("reward_evaluator", PARAMS, **node_arguments)
        self._agent: JudgeServices | None = None

    def configure(self) -> None:
        self._config = load_video_config(str(self.param("config_file")))
        device = compute_device(self._config.device)
        folder = load_video_folder(Path(str(self.param("video_model_dir"))), device)
        bags = [Path(text) for text in self.param("context_bags") if text]
        contexts = load_clips(bags, folder.clip["stride"], self._config.clip_steps, self._config.task)
        probe = load_probe(Path(str(self.param("model_dir"))), device)
        self._source = RecordedContexts(folder, contexts, self._config, probe)
        self._fps = clip_fps(bags[0], folder.clip["stride"])
        self._files = named_files(self)
        self._agent = None
        if self._config.rewards.get(AGENT):
            judge = for_task(judge_or_embedded(self._config.judge), self._config.task)
            check_clips(judge, tuple(contexts.frames.shape[1:]), self._fps)
            self._agent = JudgeServices(self, judge, self._config, lambda: self._action.busy)
        self._scores = self.publish_on("clips/scores")
        self._action = WorkerAction(self, EvaluateClips, "clips/evaluate", self._evaluate)

    def deactivate(self, reason: str) -> None:
        self._action.stop(reason)
        if self._agent is not None:
            self._agent.stop(reason)

    def update_diagnostics(self) -> None:
        if self._agent is not None:
            self._agent.update_diagnostics()

    def _evaluate(self, work: Work, result: EvaluateClips.Result) -> None:
        goal: EvaluateClips.Goal = work.request
        began = time.perf_counter()
        buffer = read_buffer(self._files, goal.buffer_uri, goal.sha256)
        request = self._source.request(buffer.iteration, buffer.policy_version)
        frames = self._source.folder.codec.decode(buffer.rollout.latents)
        verdicts: list[Verdict] = []
        if self._agent is not None:
            references = self._source.references(request)
            verdicts, result.verdicts = self._judge_clips(self._agent, work, buffer, frames, references)
        result.scores = self._score(request, buffer, frames, verdicts, goal.sha256)
        work.check()
        result.scores.eval_s = time.perf_counter() - began
        self._scores.publish(result.scores)
        self.diagnostics.latency("evaluate", result.scores.eval_s)

    def _judge_clips(
        self, agent: JudgeServices, work: Work, buffer: RolloutBuffer, frames: torch.Tensor, references: Clips
    ) -> tuple[list[Verdict], list[ClipVerdict]]:
        """The verdict of every clip, published as it is given; all by one judge and rubric."""
        goal: EvaluateClips.Goal = work.request
        jobs = buffer_jobs(
            frames, references, goal.sha256, self._config, given=self._config.model.num_conditioning, fps=self._fps
        )
        verdicts, messages = agent.judge_round(
            work, jobs, EvaluateClips.Feedback(stages_passed=[0] * len(GATED)), of=len(jobs), sha256=goal.sha256,
            deadline=deadline_of(goal.deadline_s), iteration=buffer.iteration,
        )
        check_one_judge(verdicts, buffer.group_ids.tolist())
        return verdicts, messages

    def _score(
        self, request: GroupRequest, buffer: RolloutBuffer, frames: torch.Tensor, verdicts: Sequence[Verdict],
        sha256: str,
    ) -> ClipScores:
        scores = self._source.scores(request, frames)
        if self._agent is not None:
            scores |= agent_scores(verdicts)
        total = mix_rewards(scores, self._config.rewards)
        valid = torch.isfinite(total)
        message = ClipScores(
            iteration=buffer.iteration, buffer_sha256=sha256, num_clips=len(buffer), names=list(scores),
            reward_name=REWARD_NAME if self._agent is None else AGENT,
            invalid_reason="" if bool(valid.all()) else _why_invalid(verdicts),
            pause_reason="" if self._agent is None else self._agent.pause(verdicts),
        )
        message.header = convert.header(self.get_clock().now().nanoseconds, "")
        message.total = convert.to_field(np.where(valid.numpy(), total.numpy(), np.nan))
        message.values = convert.to_field(torch.stack(list(scores.values())).double().numpy())
        message.weights = convert.to_field(np.array([self._config.rewards.get(name, 0.0) for name in scores]))
        message.valid = convert.to_field(valid.numpy())
        return message


def _why_invalid(verdicts: Sequence[Verdict]) -> str:
    invalid = [verdict for verdict in verdicts if not verdict.valid]
    if not invalid:
        return "a score is not finite"
    return f"{len(invalid)} clips without a verdict; {invalid[0].clip_id}: {invalid[0].status} {invalid[0].reason}"


def read_buffer(files: NamedFiles, uri: str, sha256: str) -> RolloutBuffer:
    """Read a rollout buffer that a goal names.

    Args:
        sha256: of the file; empty: any.

    Raises:
        RolloutBufferError: no such file, another one than announced, or no buffer in it. FileRefused: as NamedFiles.
    """
    try:
        data = files.read(uri, BUFFER)
    except OSError as error:
        raise RolloutBufferError(f"cannot read {uri}: {error.strerror}; sample again, or raise keep_buffers") from None
    digest = hashlib.sha256(data).hexdigest()
    if sha256 and digest != sha256:
        raise RolloutBufferError(f"{uri} is not the announced buffer (sha256 {digest[:12]}, not {sha256[:12]})")
    return RolloutBuffer.from_bytes(data)


def main() -> int:
    return run_node(ClipEvaluatorNode)


if __name__ == "__main__":
    sys.exit(main())
