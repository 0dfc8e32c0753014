"""What the learners of both loops share: an action that trains, and the announcement of versions."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

from wm_msgs.msg import PolicyVersion
from wm_nodes.judge.service import TrainingPaused
from wm_nodes.ros import convert
from wm_nodes.ros.actions import WorkerAction
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param
from wm_nodes.ros.worker import Work
from wm_nodes.training.run_folder import TrainingRun
from wm_nodes.training.run_lock import RunLock


class TrainingNode(ManagedNode):
    """A learner: trains by an action and announces every version of its run folder.

    A subclass calls hold_run_folder() in configure(), makes the run and calls serve_training(); it says in train() how
    a goal is trained and in fill() what a result holds. The Result of the action has the reason PAUSED, too.
    """

    inline_limit_bytes = 0
    """Weights up to this size travel inside the announcement."""

    def __init__(self, params: Sequence[Param], **node_arguments: Any) -> None:
        super().__init__("learner", params, **node_arguments)

    @abstractmethod
    def train(self, work: Work, result: Any) -> None:
        """Train as the goal asks. What it raises ends the goal as WorkerAction says; TrainingPaused with PAUSED."""

    @abstractmethod
    def fill(self, result: Any) -> Any:
        """Put the run's counts into a result, and return it."""

    def hold_run_folder(self) -> None:
        """Let nobody else write into the run folder until cleanup. Raises RunFolderInUseError."""
        lock = RunLock(self.run_dir, say=self.get_logger().warning)
        lock.acquire()
        self.own(lock.release)

    def serve_training(self, run: TrainingRun, action_type: type[Any], action: str, version_topic: str) -> None:
        """Serve the action and announce versions, until cleanup."""
        self._run = run
        self._versions = self.publish_on(version_topic)
        self._action = WorkerAction(self, action_type, action, self._train_goal, self.fill)

    @property
    def training(self) -> bool:
        """Whether a goal is at work."""
        return self._action.busy

    def deactivate(self, reason: str) -> None:
        self._action.stop(reason)

    def announce(self) -> None:
        """Publish the newest version; its files are written first. Raises OSError."""
        run = self._run
        run.ensure_saved()
        packed = run.weights_of(run.version)
        message = PolicyVersion(
            version=run.version, train_step=run.updates, uri=run.files.uri(run.version), sha256=packed.sha256,
            size_bytes=len(packed.data), format="safetensors", arch_hash=packed.arch_hash,
        )
        message.header.stamp = self.get_clock().now().to_msg()
        if len(packed.data) <= self.inline_limit_bytes:
            message.inline_data = convert.bytes_field(packed.data)
        self._versions.publish(message)

    def _train_goal(self, work: Work, result: Any) -> None:
        self.announce()  # again: others may have heard of another one since, or its files were not written
        try:
            self.train(work, result)
        except TrainingPaused as pause:
            result.termination_reason, result.message = type(result).PAUSED, str(pause)
            self.say_failed_goal(f"training ended: {result.message}")
            return
        if result.message:
            self.get_logger().warning(f"training ended: {result.message}")
        else:
            self.get_logger().info(f"training ended after update {self._run.updates}")
