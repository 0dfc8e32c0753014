"""What the learner tells about its updates: learner/metrics, metrics.jsonl, TensorBoard."""

import math

from wm_msgs.msg import LearnerMetrics
from wm_nodes.policy_rl.training_run import Progress
from wm_nodes.ros import diagnostics
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.training.metrics import MetricsWriter

FIELDS = (
    "loss_policy", "loss_value", "entropy", "approx_kl", "kl_reference", "clip_fraction", "grad_norm", "learning_rate",
    "explained_variance",
)
"""Metrics with their own field in LearnerMetrics; all others travel as names and values."""

MAX_EXTRAS = 64
COUNTS = ("mean_return", "success_rate", "dropped_invalid", "dropped_gap", "dropped_stale")


class LearnerReport:
    """Publishes on the node's learner/metrics and writes into its run folder."""

    def __init__(self, node: ManagedNode, *, tensorboard: bool) -> None:
        self._node = node
        self._publisher = node.publish_on("learner/metrics")
        self._writer = MetricsWriter(node.run_dir, tensorboard=tensorboard)
        self._nonfinite_updates = 0

    def updated(self, progress: Progress, metrics: dict[str, float], samples_per_s: float) -> None:
        """An update was made."""
        self._publish(progress, metrics, samples_per_s)
        counts = {name: getattr(progress, name) for name in COUNTS}
        self._writer.write("ppo", progress.updates, {**metrics, "samples_per_s": samples_per_s, **counts})

    def measured(self, section: str, progress: Progress, values: dict[str, float]) -> None:
        """Something was measured between two updates; its names have the section before them on the topic."""
        self._publish(progress, {f"{section}/{name}": value for name, value in values.items()}, math.nan)
        self._writer.write(section, progress.updates, values)

    def nonfinite(self, progress: Progress, error: FloatingPointError) -> None:
        """An update was undone; its metrics are unknown."""
        self._nonfinite_updates += 1
        self._node.diagnostics.count("nonfinite_updates", level=diagnostics.ERROR, text=str(error))
        self._publish(progress, {}, math.nan)

    def close(self) -> None:
        self._writer.close()

    def _publish(self, progress: Progress, metrics: dict[str, float], samples_per_s: float) -> None:
        message = LearnerMetrics(
            update=progress.updates, policy_version=progress.version, samples=progress.samples,
            mean_return=progress.mean_return, success_rate=progress.success_rate, samples_per_s=samples_per_s,
            dropped_invalid=progress.dropped_invalid, dropped_gap=progress.dropped_gap,
            dropped_stale=progress.dropped_stale,
        )
        message.header.stamp = self._node.get_clock().now().to_msg()
        for name in FIELDS:
            setattr(message, name, metrics.get(name, math.nan))
        metrics = metrics | {"nonfinite_updates": float(self._nonfinite_updates)}
        extras = {name: value for name, value in metrics.items() if name not in FIELDS}
        message.names = list(extras)[:MAX_EXTRAS]
        message.values = [extras[name] for name in message.names]
        self._publisher.publish(message)
