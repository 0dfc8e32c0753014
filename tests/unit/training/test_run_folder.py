"""Versions of weights in a run folder: their names, which are kept, and what a disk that is full leaves."""

from pathlib import Path

import pytest
import torch

from wm_nodes.policy_rl.training_run import POLICY_FILES
from wm_nodes.training.run_folder import TrainingRun, VersionFiles
from wm_nodes.training.weights import PackedWeights, save_weights
from wm_nodes.video_rl.training_run import VIDEO_FILES


class CountingRun(TrainingRun):
    """Its only weight is the version; writes fail while the disk is full."""

    files, checkpoint = VersionFiles("policies/policy"), "checkpoints/learner.json"

    def __init__(self, run_dir: Path, keep_versions: int) -> None:
        super().__init__(run_dir, keep_versions)
        self.network, self.made, self.full = torch.nn.Linear(1, 1, bias=False), 0, False

    @property
    def version(self) -> int:
        return self.made

    @property
    def updates(self) -> int:
        return self.made

    def write_files(self) -> PackedWeights:
        if self.full:
            raise OSError("no space left")
        torch.nn.init.constant_(self.network.weight, self.made)
        return save_weights(self.network, self.run_dir / self.files.uri(self.made))

    def update(self) -> None:
        self.made += 1
        self.save()


def test_files_of_both_loops_keep_their_names() -> None:
    assert POLICY_FILES.uri(3) == "policies/policy_000003.safetensors"
    assert VIDEO_FILES.uri(12) == "video_policies/video_000012.safetensors"


def test_the_newest_versions_are_kept_and_read_back_as_they_were_written(tmp_path: Path) -> None:
    run = CountingRun(tmp_path, keep_versions=2)
    assert run.saved_version == -1
    written = {}
    for _ in range(3):
        run.update()
        written[run.version] = run.weights_of(run.version)
    assert run.files.versions(tmp_path) == [2, 3]
    assert run.weights_of(2) == written[2] and run.weights_of(3) == written[3]
    with pytest.raises(FileNotFoundError):
        run.weights_of(1)


def test_files_of_the_users_in_the_same_folder_stay_and_do_not_count(tmp_path: Path) -> None:
    run = CountingRun(tmp_path, keep_versions=1)
    run.update()
    own = [f"policies/policy_{name}.safetensors" for name in ("000900", "1", "0000001", "best", "000001_mine")]
    for name in own:
        (tmp_path / name).write_bytes(b"mine")
    run.update()
    run.update()
    assert run.weights_of(3) and not (tmp_path / run.files.uri(2)).exists()
    assert all((tmp_path / name).read_bytes() == b"mine" for name in own)
    assert run.files.versions(tmp_path) == [3, 900]


def test_a_version_that_could_not_be_written_is_written_later_and_not_given_out_before(tmp_path: Path) -> None:
    run = CountingRun(tmp_path, keep_versions=2)
    run.update()
    run.full = True
    with pytest.raises(OSError, match="no space left"):
        run.update()
    assert (run.version, run.saved_version) == (2, 1)
    with pytest.raises(FileNotFoundError):
        run.weights_of(2)
    run.full = False
    run.ensure_saved()
    assert run.saved_version == 2 and run.files.versions(tmp_path) == [1, 2]
