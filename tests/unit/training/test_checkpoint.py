"""Files of tensors that are cut short or hold something else are named, with the remedy."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from wm_nodes.training.checkpoint import (
    DamagedFileError,
    read_checkpoint,
    read_metadata,
    read_tensors,
    write_checkpoint,
)
from wm_nodes.training.weights import WeightsError, load_weights_file, save_weights
from wm_nodes.video_rl.training_run import CHECKPOINT, progress


def cut(file: Path, size: int) -> None:
    file.write_bytes(file.read_bytes()[:size])


@pytest.mark.parametrize("read", [read_checkpoint, read_metadata, lambda file: read_tensors(file, "copy it again")])
@pytest.mark.parametrize("size", [0, 4, 8, 30])
def test_a_checkpoint_cut_at_any_place_is_named(read: Callable[[Path], object], size: int, tmp_path: Path) -> None:
    file = tmp_path / "state.safetensors"
    write_checkpoint(file, {"model": {"a": torch.zeros(64)}}, {"version": "1"})
    assert read_metadata(file) == {"version": "1"}
    cut(file, size)
    words = rf"{re.escape(str(file))} is damaged or cut short.*; (put a copy|copy it)"
    with pytest.raises(DamagedFileError, match=words):
        read(file)


def test_a_file_of_something_else_is_named(tmp_path: Path) -> None:
    file = tmp_path / "page.html"
    file.write_bytes(b"\xff" * 4096)
    for read in (read_checkpoint, read_metadata):
        with pytest.raises(DamagedFileError, match=re.escape(str(file))):
            read(file)


def test_a_cut_checkpoint_of_loop_2_is_named(tmp_path: Path) -> None:
    file = tmp_path / CHECKPOINT
    write_checkpoint(file, {"model": {"a": torch.zeros(64)}}, {"other": "{}"})
    with pytest.raises(DamagedFileError, match="is no checkpoint of GRPO"):
        progress(tmp_path)
    cut(file, 20)
    with pytest.raises(DamagedFileError, match=re.escape(str(file))):
        progress(tmp_path)


def test_cut_weights_are_named(tmp_path: Path) -> None:
    file, module = tmp_path / "policy.safetensors", torch.nn.Linear(3, 2)
    save_weights(module, file)
    assert "arch_hash" in load_weights_file(module, file)
    cut(file, 100)
    with pytest.raises(WeightsError, match=rf"{re.escape(str(file))}: .*cut short"):
        load_weights_file(module, file)
