"""learner of loop 2: asks for clips and their scores, trains the video model by GRPO, announces new versions."""

import math
import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from wm_msgs.action import EvaluateClips, GenerateClips, TrainVideo
from wm_msgs.msg import ClipScores
from wm_nodes.config.load import load_video_config
from wm_nodes.core.device import compute_device
from wm_nodes.judge.service import TrainingPaused
from wm_nodes.nodes.clip_evaluator_node import read_buffer
from wm_nodes.nodes.learner.training_node import TrainingNode
from wm_nodes.ros import diagnostics
from wm_nodes.ros.actions import GuardedActionClient
from wm_nodes.ros.endpoint_matching import StartBarrier
from wm_nodes.ros.goals import run_goal, same_process
from wm_nodes.ros.params import COMMON, Param, named_files
from wm_nodes.ros.spin import run_node
from wm_nodes.ros.wire import PeerLost
from wm_nodes.ros.worker import Work
from wm_nodes.video_model import RolloutBuffer, RolloutBufferError
from wm_nodes.video_model.folder import load_video_folder
from wm_nodes.video_rl.grpo import BufferReport
from wm_nodes.video_rl.reward_hacking import alarm_text
from wm_nodes.video_rl.train import post_train, sample_buffers
from wm_nodes.video_rl.training_run import VideoRun
from wm_nodes.video_rl.validation import validation_scores

PARAMS = (
    Param("video_model_dir", "", "Folder of the video model that training starts from", read_only=True),
    Param("heldout_bags", [""], "Bags of held-out contexts, scored every evaluation.every buffers", read_only=True),
    Param("model_dir", "", "World-model folder; its position probe reads the held-out clips", read_only=True),
    Param("keep_versions", 20, "Weights files kept in run_dir/video_policies", minimum=2, maximum=100000,
          read_only=True),
    Param("tensorboard", False, "Write metrics to run_dir/tensorboard too; its import takes seconds", read_only=True),
    Param("accept_timeout_s", 20.0, "How long the video model and the evaluator may take to accept a goal", "s",
          minimum=0.1, maximum=600.0),
    Param("await_nodes", [""], "Nodes of the namespace that must be active, and matched with all others, before clips "
          "are asked for; whoever else is active is waited for too"),
    Param("match_timeout_s", 20.0, "Deadline for that; then they are asked for, with a warning", "s",
          minimum=0.0, maximum=600.0),
    Param("round_deadline_s", 0.0, "Clips without a verdict so long after asking have no reward; 0: no deadline", "s",
          minimum=0.0, maximum=86400.0),
)


class VideoLearnerNode(TrainingNode):
    """Action video/train; calls video/generate and clips/evaluate; publishes video/version.

    Raises:
        ValueError: torchrun began several processes.
    """

    def __init__(self, **node_arguments: Any) -> None:
        ranks = int(os.environ.get("WORLD_SIZE", "1"))
        if ranks > 1:
            raise ValueError(f"this learner is one process, got WORLD_SIZE {ranks}; start it without torchrun")
        super().__init__(PARAMS, **node_arguments)

    def configure(self) -> None:
        self.hold_run_folder()
        values = {param.name: self.param(param.name) for param in (*COMMON, *PARAMS)}
        self._video = make_run(values, self.run_dir)
        self.own(self._video.close)
        self._watched, self.files = self._video.alarms, named_files(self)
        self._start_barrier = StartBarrier(self, self.links.table)
        self.generate = GuardedActionClient(self, GenerateClips, "video/generate")
        self.evaluate = GuardedActionClient(self, EvaluateClips, "clips/evaluate")
        self.own(self.generate.destroy)
        self.own(self.evaluate.destroy)
        self.serve_training(self._video, TrainVideo, "video/train", "video/version")

    def activate(self) -> None:
        self.announce()

    def update_diagnostics(self) -> None:
        if hasattr(self, "_video"):
            self.diagnostics.gauge("version", self._video.version)
            self.diagnostics.gauge("iterations", self._video.iterations)

    # Training, in a worker thread.

    def train(self, work: Work, result: TrainVideo.Result) -> None:
        goal: TrainVideo.Goal = work.request
        count = len(goal.from_buffers) or int(goal.iterations)
        if not count:
            raise ValueError("iterations is 0 and from_buffers is empty; ask for at least 1")
        buffers: Iterable[RolloutBuffer]
        if goal.from_buffers:
            buffers = (read_buffer(self.files, uri, "") for uri in goal.from_buffers)
        else:
            self._start_barrier.wait(work)
            buffers = sample_buffers(GraphClips(self, work), self._video, count)
        self._video.check = work.check
        for done, (_, report) in enumerate(post_train(self._video, map(self._count_invalid, buffers)), 1):
            if report.skipped:
                self.diagnostics.count("skipped_buffers", text="no group of a buffer has rewards that differ")
            self.announce()
            self._send_feedback(work, report, done, count)
            self._warn_of_hacking()

    def _count_invalid(self, buffer: RolloutBuffer) -> RolloutBuffer:
        if invalid := len(buffer) - int(buffer.valid.sum()):
            self.diagnostics.count("invalid_rewards", invalid, text=f"{invalid} clips without reward")
        return buffer

    def _send_feedback(self, work: Work, report: BufferReport, done: int, count: int) -> None:
        work.feedback(
            TrainVideo.Feedback(
                iteration=done, policy_version=self._video.version, reward_mean=report.reward_mean,
                zero_std_ratio=report.zero_std_ratio, progress=done / count,
                kl=report.updates[-1].kl if report.updates else math.nan,
            )
        )

    def _warn_of_hacking(self) -> None:
        """Say what a new held-out evaluation says of reward hacking."""
        if self._video.alarms is self._watched:
            return
        self._watched = self._video.alarms
        text = alarm_text(self._watched)
        if text:
            self.get_logger().warning(f"reward hacking: {text}")
            self.diagnostics.set_condition("reward_hacking", diagnostics.WARN, text)
        else:
            self.diagnostics.clear_condition("reward_hacking")

    def fill(self, result: TrainVideo.Result) -> TrainVideo.Result:
        result.policy_version, result.iterations = self._video.version, self._video.iterations
        result.checkpoint_uri = self._video.checkpoint
        return result


class GraphClips:
    """Clips of the graph as a source of post-training (video_rl.train.ClipSource): the video model's node samples them,
    the reward evaluator's scores them.

    Args:
        work: what the clips are for; its end ends a call.
    """

    def __init__(self, node: VideoLearnerNode, work: Work) -> None:
        self._node, self._work = node, work
        self._clips: Any = None

    def request(self, iteration: int, policy_version: int) -> GenerateClips.Goal:
        return GenerateClips.Goal(iteration=iteration, policy_version=policy_version)

    def sample(self, request: GenerateClips.Goal) -> RolloutBuffer:
        self._clips = self._ask(self._node.generate, request, "/video_model")
        return read_buffer(self._node.files, self._clips.buffer_uri, self._clips.sha256)

    def score(self, request: GenerateClips.Goal, clips: RolloutBuffer) -> RolloutBuffer:
        """Raises TrainingPaused where the evaluator asks for it."""
        goal = EvaluateClips.Goal(
            buffer_uri=self._clips.buffer_uri, sha256=self._clips.sha256,
            deadline_s=float(self._node.param("round_deadline_s")),
        )
        scores = self._ask(self._node.evaluate, goal, "/reward_evaluator").scores
        if scores.pause_reason:
            raise TrainingPaused(
                f"training pauses before iteration {request.iteration}: {scores.pause_reason}. Nothing was trained on "
                f"these clips ({self._clips.buffer_uri}); mend the judge and train again: the same clips are then "
                "judged"
            )
        return with_scores(clips, scores)

    def _ask(self, client: GuardedActionClient, goal: Any, peer: str) -> Any:
        """Raises PeerLost where nobody answers, ValueError where the peer says that it failed."""
        node, name = self._node, self._node.get_namespace().rstrip("/") + peer
        accept_s, alive = float(node.param("accept_timeout_s")), same_process(node.peers, name)
        try:
            result = run_goal(client, goal, accept_s=accept_s, check=self._work.check, alive=alive)
        except PeerLost as error:
            raise PeerLost(str(error) if name in str(error) else f"{name}: {error}") from None
        if result.termination_reason == type(result).DEACTIVATED:
            raise PeerLost(f"{name} was stopped: {result.message}")
        if result.termination_reason != type(result).FINISHED:
            raise ValueError(f"{name}: {result.message or f'ended with reason {result.termination_reason}'}")
        return result


def with_scores(buffer: RolloutBuffer, scores: ClipScores) -> RolloutBuffer:
    """The buffer with the rewards of a ClipScores message; clips with valid=0 have a NaN total.

    Raises:
        RolloutBufferError: scores of another number of clips.
    """
    count, names = len(buffer), list(scores.names)
    if scores.num_clips != count or len(scores.total) != count or len(scores.values) != count * len(names):
        raise RolloutBufferError(f"scores of {scores.num_clips} clips for a buffer of {count}; judge this buffer")
    values = torch.from_numpy(np.array(scores.values, np.float64).reshape(len(names), count))
    total, valid = (torch.from_numpy(np.array(field, np.float64)) for field in (scores.total, scores.valid))
    rewards = dict(zip(names, values, strict=True))
    return buffer.with_rewards({**rewards, "total": torch.where(valid > 0, total, torch.nan)})


def make_run(values: Mapping[str, Any], run_dir: Path) -> VideoRun:
    """The run that a node's parameters describe."""
    config = load_video_config(str(values["config_file"]))
    folder = load_video_folder(Path(str(values["video_model_dir"])), compute_device(config.device))
    bags = [Path(text) for text in values["heldout_bags"] if text]
    watched = bool(bags) and config.evaluation.every > 0
    return VideoRun(
        folder.network, config, run_dir, keep_versions=int(values["keep_versions"]),
        tensorboard=bool(values["tensorboard"]),
        heldout=validation_scores(folder, bags, Path(str(values["model_dir"])), config) if watched else None,
    )


def main() -> int:
    return run_node(VideoLearnerNode)


if __name__ == "__main__":
    sys.exit(main())
