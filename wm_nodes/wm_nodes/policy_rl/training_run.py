"""The state of policy training in a run folder: weights, version, counts, checkpoints. No rclpy.

Version v is written as run_dir/policies/policy_<v>.safetensors. The checkpoint that holds version v is on disk before
v is announced, so that a version number never stands for two different weights, restarts included.
"""

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch.distributed

from wm_nodes.core.files import write_atomic
from wm_nodes.core.types import Rollout
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.rollouts import Canceled, rollout_statistics, terminate_at_episode_end
from wm_nodes.training.ranks import Ranks, broadcast_rollout
from wm_nodes.training.weights import PackedWeights, load_weights, pack_weights

CHECKPOINT = Path("checkpoints") / "learner.json"


@dataclass(frozen=True)
class DroppedTransitions:
    """Transitions (single environments' steps) left out of a rollout, by reason."""

    invalid: int = 0
    gap: int = 0
    stale: int = 0


class Learner(Protocol):
    """What the learner node needs of an algorithm; learning.ppo.PpoLearner is one."""

    def update(self, rollout: Rollout, *, should_stop: Callable[[], bool] | None = None) -> Any:
        """Train on one rollout; return metrics, a mapping or a dataclass of numbers.

        Raises learning.rollouts.Canceled when should_stop said so; the weights are then as they were before.
        Raises FloatingPointError when a loss, gradient or weight is not finite; likewise.
        """
        ...

    def save(self, path: Path) -> None:
        """Write everything that an exact continuation needs (optimiser, counters, random streams), atomically."""
        ...

    def load(self, path: Path) -> None: ...


@dataclass
class Progress:
    """Counts over the whole run folder. samples: valid transitions trained on."""

    updates: int = 0
    version: int = 1
    samples: int = 0
    dropped_invalid: int = 0
    dropped_gap: int = 0
    dropped_stale: int = 0
    mean_return: float = math.nan
    success_rate: float = math.nan


class PolicyTraining:
    """Updates a policy and keeps its versions in a run folder.

    Args:
        resume: continue from the newest checkpoint of the run folder, where there is one.
        keep_versions: weights files kept; older ones are deleted.
    """

    def __init__(
        self, policy: ImagePolicy, learner: Learner, run_dir: Path, *, resume: bool, keep_versions: int,
        metadata: Mapping[str, str], ranks: Ranks | None = None,
    ) -> None:
        self._ranks = ranks or Ranks()
        self.policy, self.learner, self.run_dir = policy, learner, run_dir
        self.progress = Progress()
        self._keep_versions, self._metadata = keep_versions, dict(metadata)
        self.packed: PackedWeights
        self._saved = True
        if resume and self.checkpoint.is_file():
            self._restore()
        else:
            self.progress.version = self._last_version() + 1
            self.save_checkpoint()
        self._write_version()
        barrier(self._ranks)

    @property
    def checkpoint(self) -> Path:
        """The file that marks a complete checkpoint; its sibling .learner holds the algorithm's state."""
        return self.run_dir / CHECKPOINT

    def update(
        self,
        rollout: Rollout,
        dropped: DroppedTransitions,
        should_stop: Callable[[], bool],
        *,
        paid_at_end: bool = False,
    ) -> dict[str, float]:
        """Make one update and one new version; return the metrics.

        Args:
            paid_at_end: an episode's only reward comes with its last step; see terminate_at_episode_end.

        Raises:
            Canceled, FloatingPointError: nothing has changed. ValueError: the rollout cannot be trained on.
            OSError: the update was made, but its files were not written; ensure_saved() tries again.
        """
        began = time.perf_counter()
        trained = terminate_at_episode_end(rollout) if paid_at_end else rollout
        broadcast_rollout(trained, self._ranks)
        found = self.learner.update(trained, should_stop=should_stop)
        statistics = rollout_statistics(rollout)
        progress = self.progress
        progress.updates += 1
        progress.version += 1
        progress.samples += int(rollout.valid_TN.sum())
        progress.dropped_invalid += dropped.invalid
        progress.dropped_gap += dropped.gap
        progress.dropped_stale += dropped.stale
        progress.mean_return, progress.success_rate = statistics.mean_return, statistics.success_rate
        self._saved = False
        self.ensure_saved()
        metrics = _numbers(found)
        metrics["update_s"] = time.perf_counter() - began
        metrics |= {"episodes": float(statistics.episodes), "cut_episodes": float(statistics.cut)}
        return metrics

    def ensure_saved(self) -> bool:
        """Write the files of the newest version if a full disk, say, kept them from it; return whether it did."""
        if self._saved:
            return False
        self.save_checkpoint()
        self._write_version()
        self._saved = True
        return True

    def close(self) -> None:
        """Let the other ranks end."""
        broadcast_rollout(None, self._ranks)

    def save_checkpoint(self, path: Path | None = None) -> Path:
        """Write weights, learner state and counts; return the file that names them."""
        path = path or self.checkpoint
        self.packed = pack_weights(self.policy, {**self._metadata, "policy_version": str(self.progress.version)})
        generation = self.progress.updates
        weights, state = (path.with_name(f"{path.stem}_{generation:06d}.{kind}") for kind in ("safetensors", "learner"))
        write_atomic(weights, self.packed.data)
        self.learner.save(state)
        content = {"progress": asdict(self.progress), "weights": weights.name, "learner": state.name,
                   "sha256": self.packed.sha256}
        write_atomic(path, json.dumps(content, indent=1).encode())
        for kind in ("safetensors", "learner"):
            for old in path.parent.glob(f"{path.stem}_*.{kind}"):
                if old not in (weights, state):
                    old.unlink(missing_ok=True)
        return path

    def weights_of(self, version: int) -> tuple[int, bytes]:
        """Return (version, bytes); 0 means the newest. Raises FileNotFoundError."""
        version = version or self.progress.version
        if version == self.progress.version:
            return version, self.packed.data
        return version, (self.run_dir / weights_uri(version)).read_bytes()

    def _restore(self) -> None:
        self.progress = restore(self.policy, self.learner, self.checkpoint)
        self.packed = pack_weights(self.policy, {**self._metadata, "policy_version": str(self.progress.version)})

    def _write_version(self) -> None:
        write_atomic(self.run_dir / weights_uri(self.progress.version), self.packed.data)
        files = sorted((self.run_dir / "policies").glob("policy_*.safetensors"))
        for old in files[: -self._keep_versions]:
            old.unlink(missing_ok=True)

    def _last_version(self) -> int:
        names = [path.stem.removeprefix("policy_") for path in (self.run_dir / "policies").glob("policy_*.safetensors")]
        return max((int(name) for name in names if name.isdigit()), default=0)


def restore(policy: ImagePolicy, learner: Learner, checkpoint: Path) -> Progress:
    """Load a checkpoint into policy and learner; return its counts.

    Raises:
        ValueError: a damaged file, or one of another architecture, algorithm or seed; names it.
    """
    try:
        content = json.loads(checkpoint.read_text())
        load_weights(policy, (checkpoint.parent / content["weights"]).read_bytes(), sha256=content["sha256"])
        learner.load(checkpoint.parent / content["learner"])
        return Progress(**content["progress"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"checkpoint {checkpoint} does not fit: {error}; go on with the configuration it was made by, or begin "
            "anew in another run_dir"
        ) from None


def follow(policy: ImagePolicy, learner: Learner, run_dir: Path, ranks: Ranks) -> None:
    """Be a rank other than 0: start from rank 0's checkpoint and make its updates until it ends."""
    barrier(ranks)
    restore(policy, learner, run_dir / CHECKPOINT)
    while (rollout := broadcast_rollout(None, ranks)) is not None:
        try:
            learner.update(rollout)
        except (Canceled, ValueError, FloatingPointError):
            continue


def weights_uri(version: int) -> str:
    """File name of a policy version, relative to the run folder."""
    return f"policies/policy_{version:06d}.safetensors"


def barrier(ranks: Ranks) -> None:
    if ranks.size > 1:
        torch.distributed.barrier()


def _numbers(found: Any) -> dict[str, float]:
    values = asdict(found) if is_dataclass(found) and not isinstance(found, type) else dict(found)
    return {name: float(value) for name, value in values.items() if isinstance(value, (int, float, np.number))}
