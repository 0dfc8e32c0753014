"""A run folder of loop 2: the learner with its versions, checkpoint and metrics, resumed where it stopped.

versions: run_dir/video_policies/video_<optimizer steps>.safetensors; version 0 is the model's own folder.
"""

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

import torch

from wm_nodes.learning.distributed import Ranks
from wm_nodes.learning.metrics import MetricsWriter
from wm_nodes.learning.video_config import VideoRlConfig
from wm_nodes.learning.video_grpo import BufferReport, GrpoLearner
from wm_nodes.learning.weights import PackedWeights, save_weights
from wm_nodes.video_model import RolloutBuffer, VideoNetwork

CHECKPOINT = "checkpoints/video_learner.safetensors"


def version_uri(version: int) -> str:
    """File name of a version of the network, relative to the run folder."""
    return f"video_policies/video_{version:06d}.safetensors"


class VideoRun:
    """Trains `network` on buffers; every buffer leaves a version, a checkpoint and a line of metrics.

    Args:
        keep_versions: files kept in run_dir/video_policies.
    """

    def __init__(
        self, network: VideoNetwork, config: VideoRlConfig, run_dir: Path, *, keep_versions: int = 20,
        tensorboard: bool = False, ranks: Ranks | None = None,
    ) -> None:  # fmt: skip
        self.network, self.config, self.run_dir, self._keep = network, config, run_dir, keep_versions
        self.learner = GrpoLearner(network, config.grpo, config.rollout, seed=config.seed, ranks=ranks)
        self.iterations = 0
        """Buffers trained on in the run folder."""
        if (run_dir / CHECKPOINT).is_file():
            self.iterations = self.learner.load(run_dir / CHECKPOINT)
        self._metrics = MetricsWriter(run_dir, tensorboard=tensorboard) if not ranks or ranks.rank == 0 else None

        self.packed: PackedWeights | None = None
        """What train() or save() wrote last."""

    @property
    def version(self) -> int:
        return self.learner.version

    def train(self, buffer: RolloutBuffer) -> BufferReport:
        """Train on one buffer with rewards, then save. Raises as GrpoLearner.train, or OSError where saving fails."""
        report = self.learner.train(buffer)
        self.iterations += 1
        if self._metrics is not None:
            self.save()
            self._metrics.write("grpo", self.iterations, flat_metrics(report))
        return report

    def save(self) -> PackedWeights:
        """Write the version and the checkpoint, the checkpoint last; return the version's weights."""
        path = self.run_dir / version_uri(self.version)
        self.packed = save_weights(self.network, path, {"version": str(self.version)})
        self.learner.save(self.run_dir / CHECKPOINT, iteration=self.iterations)
        for old in sorted((self.run_dir / "video_policies").glob("video_*.safetensors"))[: -self._keep]:
            old.unlink(missing_ok=True)
        return self.packed

    def close(self) -> None:
        if self._metrics is not None:
            self._metrics.close()


def flat_metrics(report: BufferReport) -> dict[str, float]:
    """One number per name; those of the k-th optimizer step on a buffer end in _<k>, from 1."""
    values = asdict(report)
    updates = values.pop("updates")
    found = {name: float(value) for name, value in values.items()}
    for index, update in enumerate(updates, 1):
        found |= {f"{name}_{index}": float(value) for name, value in update.items()}
    return found


def rewarded(buffer: RolloutBuffer, scores: Mapping[str, torch.Tensor], total: torch.Tensor) -> RolloutBuffer:
    """The buffer with raw scores and the mixed reward `total`; a clip whose total is NaN is left out of training."""
    raw = {name: values.double() for name, values in scores.items()}
    return replace(buffer.with_rewards({"total": total}), rewards={**raw, "total": total.double()})
