"""reward_evaluator of loop 2: judges the clips of a rollout buffer against the recordings of their contexts."""

import hashlib
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from wm_msgs.action import EvaluateClips
from wm_msgs.msg import ClipScores
from wm_nodes.learning.clip_generation import ClipGenerator
from wm_nodes.learning.clip_scores import mixed, score_clips
from wm_nodes.learning.video_config import load_video_config
from wm_nodes.learning.video_data import load_clips
from wm_nodes.learning.video_folder import load_video_folder
from wm_nodes.ros import convert, diagnostics
from wm_nodes.ros.actions import Work, WorkerAction
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param
from wm_nodes.ros.spin import run_node
from wm_nodes.video_model import RolloutBuffer, RolloutBufferError
from wm_nodes.world_model import load_model_folder

PARAMS = (
    Param("video_model_dir", "", "Folder of the video model; its codec decodes the clips", read_only=True),
    Param("context_bags", [""], "Bags of the contexts, the same and in the same order as the video_model node's",
          read_only=True),
    Param("model_dir", "", "World-model folder; its position probe reads the pictures", read_only=True),
)  # fmt: skip

REWARD_NAME = "reference"


class ClipEvaluatorNode(ManagedNode):
    """Action clips/evaluate; publishes clips/scores."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("reward_evaluator", PARAMS, **node_arguments)

    def configure(self) -> None:
        self._config = load_video_config(str(self.param("config_file")))
        folder = load_video_folder(Path(str(self.param("video_model_dir"))))
        bags = [Path(text) for text in self.param("context_bags") if text]
        self._generator = ClipGenerator(folder, load_clips(bags, folder.clip["stride"]), self._config)
        probe = load_model_folder(Path(str(self.param("model_dir")))).probe
        if probe is None:
            raise ValueError(f"{self.param('model_dir')} has no position probe; take the shipped world model")
        self._probe = probe
        self._scores = self.publish_on("clips/scores")
        self._action = WorkerAction(self, EvaluateClips, "clips/evaluate", self._evaluate, self._describe)
        self.own(self._action.destroy)

    def deactivate(self, reason: str) -> None:
        self._action.stop(reason)

    def _evaluate(self, work: Work) -> EvaluateClips.Result:
        goal: EvaluateClips.Goal = work.request
        result = EvaluateClips.Result(termination_reason=EvaluateClips.Result.FINISHED)
        try:
            began = time.perf_counter()
            buffer = read_buffer(self.run_dir / goal.buffer_uri, goal.sha256)
            result.scores = self._score(buffer, goal.sha256)
            work.check()
            result.scores.eval_s = time.perf_counter() - began
            self._scores.publish(result.scores)
            self.diagnostics.latency("evaluate", result.scores.eval_s)
        except (RolloutBufferError, ValueError, OSError) as error:
            result.termination_reason, result.message = EvaluateClips.Result.FAILED, str(error)
            self.get_logger().error(f"{goal.buffer_uri} not judged: {error}")
            self.diagnostics.count("failed_goals", level=diagnostics.ERROR, text=str(error))
        return result

    def _score(self, buffer: RolloutBuffer, sha256: str) -> ClipScores:
        frames = self._generator.folder.codec.decode(buffer.rollout.latents)
        request = self._generator.request(buffer.iteration, buffer.policy_version)
        found = score_clips(
            frames, self._generator.references(request), self._probe, buffer.condition.num_conditioning
        ).named()
        total = mixed(found, self._config.rewards)
        valid = torch.isfinite(total)
        message = ClipScores(
            iteration=buffer.iteration, buffer_sha256=sha256, num_clips=len(buffer), names=list(found),
            reward_name=REWARD_NAME, invalid_reason="" if bool(valid.all()) else "a score is not finite",
        )  # fmt: skip
        message.header = convert.header(self.get_clock().now().nanoseconds, "")
        message.total = convert.to_field(np.where(valid.numpy(), total.numpy(), np.nan))
        message.values = convert.to_field(torch.stack(list(found.values())).double().numpy())
        message.weights = convert.to_field(np.array([self._config.rewards.get(name, 0.0) for name in found]))
        message.valid = convert.to_field(valid.numpy())
        return message

    @staticmethod
    def _describe(reason: int, text: str) -> EvaluateClips.Result:
        return EvaluateClips.Result(termination_reason=reason, message=text)


def read_buffer(path: Path, sha256: str) -> RolloutBuffer:
    """Read a rollout buffer.

    Args:
        sha256: of the file; empty: any.

    Raises:
        RolloutBufferError: no such file, another one than announced, or no buffer in it.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RolloutBufferError(f"cannot read {path}: {error.strerror}; sample again, or raise keep_buffers") from None
    found = hashlib.sha256(data).hexdigest()
    if sha256 and found != sha256:
        raise RolloutBufferError(f"{path} is not the announced buffer (sha256 {found[:12]}, not {sha256[:12]})")
    return RolloutBuffer.from_bytes(data)


def main() -> int:
    return run_node(ClipEvaluatorNode)


if __name__ == "__main__":
    sys.exit(main())
