"""The training of a run folder: numbered versions of the weights, and a checkpoint to continue from.

The files of version v, and the checkpoint that holds it, are on disk before v is announced, so that a version number
never stands for two different weights, restarts included.
"""

import hashlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

from wm_nodes.core.named_files import WEIGHTS, read_regular
from wm_nodes.training.weights import PackedWeights, unpack_weights


@dataclass(frozen=True)
class VersionFiles:
    """Names of numbered weights files. stem: e.g. "policies/policy" for policies/policy_000003.safetensors."""

    stem: str

    def uri(self, version: int) -> str:
        """File name of a version, relative to the run folder."""
        return f"{self.stem}_{version:06d}.safetensors"

    def versions(self, run_dir: Path) -> list[int]:
        """The versions in the run folder, ascending."""
        path = run_dir / self.stem
        names = (file.stem.removeprefix(f"{path.name}_") for file in path.parent.glob(f"{path.name}_*.safetensors"))
        return sorted(int(name) for name in names if name.isdecimal() and f"{int(name):06d}" == name)

    def prune(self, run_dir: Path, keep: int, newest: int) -> None:
        """Delete all but the newest `keep` versions up to `newest`; files of later numbers are not this run's."""
        for version in [version for version in self.versions(run_dir) if version <= newest][:-keep]:
            (run_dir / self.uri(version)).unlink(missing_ok=True)


class TrainingRun(ABC):
    """What the runs of both loops share.

    Args:
        keep_versions: weights files kept; older ones are deleted.
    """

    files: VersionFiles
    checkpoint: str
    """File name of the checkpoint, relative to the run folder."""

    def __init__(self, run_dir: Path, keep_versions: int) -> None:
        self.run_dir, self._keep_versions = run_dir, keep_versions
        self._newest: tuple[int, PackedWeights] | None = None

    @property
    @abstractmethod
    def version(self) -> int:
        """The version that the last update made; its files may not be written yet."""

    @property
    @abstractmethod
    def updates(self) -> int:
        """Updates made in the run folder."""

    @abstractmethod
    def write_files(self) -> PackedWeights:
        """Write the version's weights and the checkpoint; return the weights. Raises OSError."""

    @property
    def saved_version(self) -> int:
        """The newest version whose files are written; -1 before any."""
        return -1 if self._newest is None else self._newest[0]

    def save(self) -> None:
        """Write the files of the version, and delete those of old ones. Raises OSError."""
        self._newest = self.version, self.write_files()
        self.files.prune(self.run_dir, self._keep_versions, self.version)

    def ensure_saved(self) -> None:
        """Write the files of the version where, say, a full disk kept them from it. Raises OSError."""
        if self.saved_version != self.version:
            self.save()

    def weights_of(self, version: int) -> PackedWeights:
        """The weights of a version that was written. Raises OSError where its file is gone, ValueError for another."""
        newest = self._newest
        if newest is not None and newest[0] == version:
            return newest[1]
        data = read_regular(self.run_dir / self.files.uri(version), WEIGHTS)
        _, metadata = unpack_weights(data)
        return PackedWeights(data, hashlib.sha256(data).hexdigest(), metadata["arch_hash"], metadata)
