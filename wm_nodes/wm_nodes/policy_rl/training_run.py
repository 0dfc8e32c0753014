"""A run folder of loop 1: the policy with its versions, counts and checkpoint, resumed where it stopped.

Versions: run_dir/policies/policy_<version>.safetensors, from 1.
"""

import hashlib
import json
import math
import os
import re
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch.distributed

from wm_nodes.core.files import write_atomic
from wm_nodes.core.lockstep import DroppedTransitions
from wm_nodes.core.model_folder import read_json
from wm_nodes.core.named_files import CHECKPOINT, read_regular
from wm_nodes.core.types import Rollout
from wm_nodes.policy_rl.image_policy import ImagePolicy
from wm_nodes.policy_rl.learner import Learner
from wm_nodes.policy_rl.rollouts import Canceled, TensorRollout, rollout_statistics, terminate_at_episode_end
from wm_nodes.training.checkpoint import RESTORE, DamagedFileError
from wm_nodes.training.ranks import Ranks, broadcast_rollout
from wm_nodes.training.run_folder import TrainingRun, VersionFiles
from wm_nodes.training.weights import PackedWeights, load_weights, pack_weights

POLICY_FILES = VersionFiles("policies/policy")


@dataclass
class Progress:
    """Counts over the whole run folder."""

    updates: int = 0
    """Updates made."""
    version: int = 1
    """The policy's newest version."""
    samples: int = 0
    """Valid transitions trained on."""
    dropped_invalid: int = 0
    """Transitions left out as their step or reward is invalid."""
    dropped_gap: int = 0
    """Transitions left out as a message about them is missing."""
    dropped_stale: int = 0
    """Transitions left out as another version acted."""
    mean_return: float = math.nan
    """Of the newest rollout, see RolloutStatistics."""
    success_rate: float = math.nan
    """Of the newest rollout, see RolloutStatistics."""
    unfailed: int = 0
    """Updates in a row, up to the newest, in whose rollouts no episode failed."""


class PolicyTraining(TrainingRun):
    """Updates a policy; every update leaves a version and a checkpoint.

    The checkpoint is a JSON file; beside it lie the weights and, in a .learner file, the algorithm's state.

    Args:
        resume: continue from the newest checkpoint of the run folder, where there is one.
        ranks: this process's place; rank 0 writes the files, the others follow() it.
    """

    files, checkpoint = POLICY_FILES, "checkpoints/learner.json"

    def __init__(
        self, policy: ImagePolicy, learner: Learner, run_dir: Path, *, resume: bool, keep_versions: int,
        metadata: Mapping[str, str], ranks: Ranks | None = None,
    ) -> None:
        super().__init__(run_dir, keep_versions)
        self.ranks = ranks or Ranks()
        self.policy, self.learner, self._metadata = policy, learner, dict(metadata)
        self.progress = Progress()
        if self.ranks.rank:
            barrier(self.ranks)  # until rank 0 has written its checkpoint
            self.progress = restore(policy, learner, run_dir / self.checkpoint)
            return
        if resume and (run_dir / self.checkpoint).is_file():
            self.progress = restore(policy, learner, run_dir / self.checkpoint)
        else:
            self.progress.version = max(self.files.versions(run_dir), default=0) + 1
        self.save()
        barrier(self.ranks)

    @property
    def version(self) -> int:
        return self.progress.version

    @property
    def updates(self) -> int:
        return self.progress.updates

    def update(
        self, rollout: Rollout | TensorRollout, dropped: DroppedTransitions, should_stop: Callable[[], bool], *,
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
        if isinstance(trained, Rollout):
            broadcast_rollout(trained, self.ranks)
        elif self.ranks.size > 1:
            raise ValueError(
                f"device rollouts are for a learner of one process, and this one has {self.ranks.size}; start it "
                "without torchrun, or without --device-rollouts"
            )
        learner_metrics = self.learner.update(trained, should_stop=should_stop)
        statistics = rollout_statistics(rollout)
        metrics = _read_numbers(learner_metrics)
        progress = self.progress
        progress.updates += 1
        progress.version += 1
        progress.samples += int(metrics.get("samples", rollout.valid_TN.sum()))
        progress.dropped_invalid += dropped.invalid
        progress.dropped_gap += dropped.gap
        progress.dropped_stale += dropped.stale
        progress.mean_return, progress.success_rate = statistics.mean_return, statistics.success_rate
        progress.unfailed = statistics.unfailed_after(progress.unfailed)
        self.save()
        seconds = time.perf_counter() - began
        counts = {"episodes": float(statistics.episodes), "cut_episodes": float(statistics.cut)}
        return metrics | {"update_s": seconds} | counts

    def follow(self) -> None:
        """Be a rank other than 0: make rank 0's updates until it closes."""
        while (rollout := broadcast_rollout(None, self.ranks)) is not None:
            with suppress(Canceled, ValueError, FloatingPointError):  # rank 0 has raised and reported the same
                self.learner.update(rollout)

    def close(self) -> None:
        """Let the other ranks end."""
        broadcast_rollout(None, self.ranks)

    def write_files(self) -> PackedWeights:
        packed = self.save_checkpoint(self.run_dir / self.checkpoint)
        write_atomic(self.run_dir / self.files.uri(self.version), packed.data)
        return packed

    def save_checkpoint(self, path: Path) -> PackedWeights:
        """Write weights, learner state and counts; `path` becomes the file that names them. Return the weights.

        What the checkpoint before it at `path` names is removed, and nothing else is touched.

        Raises:
            ValueError: a file lies there that is no checkpoint, or that none names. OSError.
        """
        weights, state = (
            path.with_name(f"{path.stem}_{self.updates:06d}.{kind}") for kind in ("safetensors", "learner")
        )
        before = named_by_checkpoint(path) if os.path.lexists(path) else set()
        if path != self.run_dir / self.checkpoint:  # beside the run's own, a kill may have left files that none names
            check_free(path, {weights, state} - before)
        packed = pack_weights(self.policy, {**self._metadata, "policy_version": str(self.version)})
        write_atomic(weights, packed.data)
        self.learner.save(state)
        content = {"progress": asdict(self.progress), "weights": weights.name, "learner": state.name,
                   "sha256": packed.sha256}
        write_atomic(path, json.dumps(content, indent=1).encode())
        for old in before - {weights, state}:
            old.unlink(missing_ok=True)
        return packed


def named_by_checkpoint(path: Path) -> set[Path]:
    """The files beside a checkpoint that it names as its own. Raises ValueError where no checkpoint lies there."""
    try:
        content = json.loads(read_regular(path, CHECKPOINT))
        Progress(**content["progress"])
        names = [content["weights"], content["learner"]]
        if not all(re.fullmatch(rf"{re.escape(path.stem)}_\d+\.(safetensors|learner)", name) for name in names):
            raise ValueError("it names files of another checkpoint")
        return {path.with_name(name) for name in names}
    except (KeyError, TypeError, ValueError, OSError) as error:
        text = f"{path} is there and is no checkpoint of a learner ({error}); take another name"
        raise ValueError(text.replace("\n", " ")) from None


def check_free(path: Path, generated: Iterable[Path]) -> None:
    """Raise ValueError unless a checkpoint of a name that somebody chose meets no file of others."""
    if path.suffix != ".json":
        raise ValueError(f"{path} must end in .json: weights and learner state lie beside it under other endings")
    if taken := [str(file) for file in generated if os.path.lexists(file)]:
        raise ValueError(f"{' and '.join(sorted(taken))} would be overwritten; take another name than {path.name}")


def restore(policy: ImagePolicy, learner: Learner, checkpoint: Path) -> Progress:
    """Load a checkpoint into policy and learner; return its counts.

    Raises:
        ValueError: a damaged file, or one of another architecture, algorithm or seed; names it.
    """
    content = read_json(checkpoint, RESTORE)
    try:
        weights = checkpoint.parent / content["weights"]
        data = weights.read_bytes()
        if hashlib.sha256(data).hexdigest() != content["sha256"]:
            raise DamagedFileError(f"{weights} is not the file that {checkpoint} names (sha256 differs); {RESTORE}")
        load_weights(policy, data)
        learner.load(checkpoint.parent / content["learner"])
        return Progress(**content["progress"])
    except DamagedFileError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"checkpoint {checkpoint} does not fit: {error}; go on with the configuration it was made by, or begin "
            "anew in another run_dir"
        ) from None


def barrier(ranks: Ranks) -> None:
    if ranks.size > 1:
        torch.distributed.barrier()


def _read_numbers(metrics: Any) -> dict[str, float]:
    values = asdict(metrics) if is_dataclass(metrics) and not isinstance(metrics, type) else dict(metrics)
    return {name: float(value) for name, value in values.items() if isinstance(value, (int, float, np.number))}
