"""learner of loop 2: asks for clips and their scores, trains the video model by GRPO, announces new versions."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rclpy.action import ActionClient

from wm_msgs.action import EvaluateClips, GenerateClips, TrainVideo
from wm_msgs.msg import ClipScores, PolicyVersion
from wm_nodes.learning.video_config import load_video_config
from wm_nodes.learning.video_folder import load_video_folder
from wm_nodes.learning.video_grpo import BufferReport
from wm_nodes.learning.video_run import CHECKPOINT, VideoRun, rewarded, version_uri
from wm_nodes.nodes.clip_evaluator_node import read_buffer
from wm_nodes.ros import convert, diagnostics
from wm_nodes.ros.actions import Work, WorkerAction
from wm_nodes.ros.clients import run_goal
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param
from wm_nodes.ros.spin import run_node
from wm_nodes.ros.wire import PeerLost
from wm_nodes.video_model import RolloutBuffer, RolloutBufferError

PARAMS = (
    Param("video_model_dir", "", "Folder of the video model that training starts from", read_only=True),
    Param("keep_versions", 20, "Weights files kept in run_dir/video_policies", minimum=1, maximum=100000,
          read_only=True),
    Param("tensorboard", False, "Write metrics to run_dir/tensorboard too; its import takes seconds", read_only=True),
    Param("accept_timeout_s", 20.0, "How long the video model and the evaluator may take to accept a goal", "s",
          minimum=0.1, maximum=600.0),
)  # fmt: skip


class VideoLearnerNode(ManagedNode):
    """Action video/train; calls video/generate and clips/evaluate; publishes video/version."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("learner", PARAMS, **node_arguments)

    def configure(self) -> None:
        config = load_video_config(str(self.param("config_file")))
        folder = load_video_folder(Path(str(self.param("video_model_dir"))))
        self._run = VideoRun(
            folder.network, config, self.run_dir, keep_versions=int(self.param("keep_versions")),
            tensorboard=bool(self.param("tensorboard")),
        )  # fmt: skip
        self.own(self._run.close)
        self._versions = self.publish_on("video/version")
        self._generate = ActionClient(self, GenerateClips, "video/generate")
        self._evaluate = ActionClient(self, EvaluateClips, "clips/evaluate")
        self.own(self._generate.destroy)
        self.own(self._evaluate.destroy)
        self._action = WorkerAction(self, TrainVideo, "video/train", self._train, self._describe)
        self.own(self._action.destroy)

    def activate(self) -> None:
        self._announce()

    def deactivate(self, reason: str) -> None:
        self._action.stop(reason)

    def update_diagnostics(self) -> None:
        if hasattr(self, "_run"):
            self.diagnostics.gauge("version", self._run.version)
            self.diagnostics.gauge("iterations", self._run.iterations)

    # Training, in a worker thread.

    def _train(self, work: Work) -> TrainVideo.Result:
        goal: TrainVideo.Goal = work.request
        result = TrainVideo.Result(termination_reason=TrainVideo.Result.FINISHED)
        try:
            count = len(goal.from_buffers) or int(goal.iterations)
            if not count:
                raise ValueError("iterations is 0 and from_buffers is empty; ask for at least 1")
            for done in range(count):
                work.check()
                path = goal.from_buffers[done] if goal.from_buffers else ""
                buffer = read_buffer(self.run_dir / path, "") if path else self._sampled(work)
                report = self._run.train(buffer)
                self._announce()
                self._tell(work, report, done + 1, count)
        except PeerLost as error:
            result.termination_reason, result.message = TrainVideo.Result.PEER_LOST, str(error)
        except (RolloutBufferError, ValueError, OSError, FloatingPointError) as error:
            result.termination_reason, result.message = TrainVideo.Result.FAILED, str(error)
        if result.message:
            self.get_logger().error(f"training ended: {result.message}")
            self.diagnostics.count("failed_goals", level=diagnostics.ERROR, text=result.message)
        return self._fill(result)

    def _sampled(self, work: Work) -> RolloutBuffer:
        """A buffer of fresh clips with their rewards; also written beside the one without, for training offline."""
        goal = GenerateClips.Goal(iteration=self._run.iterations, policy_version=self._run.version)
        clips = self._ask(self._generate, goal, work, "/video_model")
        judged = self._ask(
            self._evaluate, EvaluateClips.Goal(buffer_uri=clips.buffer_uri, sha256=clips.sha256), work,
            "/reward_evaluator",
        )  # fmt: skip
        buffer = read_buffer(self.run_dir / clips.buffer_uri, clips.sha256)
        return with_scores(buffer, judged.scores)

    def _ask(self, client: ActionClient, goal: Any, work: Work, peer: str) -> Any:
        """Raises PeerLost where nobody answers, ValueError where the peer says that it failed."""
        name = self.get_namespace().rstrip("/") + peer

        def alive() -> None:
            if self.peers.is_lost(name):
                raise PeerLost(f"{name} is silent")

        result = run_goal(
            client, goal, accept_s=float(self.param("accept_timeout_s")), check=work.check, alive=alive
        )
        if result.termination_reason != type(result).FINISHED:
            raise ValueError(f"{name}: {result.message or f'ended with reason {result.termination_reason}'}")
        return result

    def _tell(self, work: Work, report: BufferReport, done: int, count: int) -> None:
        if report.invalid:
            self.diagnostics.count("invalid_rewards", report.invalid, text=f"{report.invalid} clips without reward")
        work.feedback(
            TrainVideo.Feedback(
                iteration=done, policy_version=self._run.version, reward_mean=report.reward_mean,
                zero_std_ratio=report.zero_std_ratio, kl=report.updates[-1].kl, progress=done / count,
            )
        )  # fmt: skip

    def _announce(self) -> None:
        packed, version = self._run.packed or self._run.save(), self._run.version
        message = PolicyVersion(
            version=version, train_step=self._run.iterations, uri=version_uri(version), sha256=packed.sha256,
            size_bytes=len(packed.data), format="safetensors", arch_hash=packed.arch_hash,
        )  # fmt: skip
        message.header.stamp = self.get_clock().now().to_msg()
        self._versions.publish(message)

    def _fill(self, result: TrainVideo.Result) -> TrainVideo.Result:
        result.policy_version, result.iterations = self._run.version, self._run.iterations
        result.checkpoint_uri = CHECKPOINT
        return result

    def _describe(self, reason: int, text: str) -> TrainVideo.Result:
        return self._fill(TrainVideo.Result(termination_reason=reason, message=text))


def with_scores(buffer: RolloutBuffer, scores: ClipScores) -> RolloutBuffer:
    """The buffer with the rewards of a ClipScores message; clips with valid=0 have a NaN total.

    Raises:
        RolloutBufferError: scores of another number of clips.
    """
    count, names = len(buffer), list(scores.names)
    if scores.num_clips != count or len(scores.total) != count or len(scores.values) != count * len(names):
        raise RolloutBufferError(f"scores of {scores.num_clips} clips for a buffer of {count}; judge this buffer")
    values = torch.from_numpy(convert.from_field(scores.values, np.float64).reshape(len(names), count).copy())
    total = torch.from_numpy(convert.from_field(scores.total, np.float64).copy())
    valid = torch.from_numpy(convert.from_field(scores.valid, np.uint8).copy()).bool()
    return rewarded(buffer, dict(zip(names, values, strict=True)), torch.where(valid, total, torch.nan))


def main() -> int:
    return run_node(VideoLearnerNode)


if __name__ == "__main__":
    sys.exit(main())
