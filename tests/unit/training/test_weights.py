"""Weights: equal bytes for equal content, every damage and every other architecture named, nothing half-loaded."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save
from torch import nn

from wm_nodes.core.files import write_atomic
from wm_nodes.training.weights import WeightsError, arch_hash, load_weights, pack_weights, save_weights, unpack_weights


def make(seed: int, width: int = 4) -> nn.Module:
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(3, width), nn.BatchNorm1d(width))


def test_round_trip_restores_parameters_buffers_and_metadata() -> None:
    first, second = make(0), make(1)
    packed = pack_weights(first, {"task": "reach"})
    metadata = load_weights(second, packed.data, sha256=packed.sha256)
    assert metadata["task"] == "reach"
    for name, tensor in first.state_dict().items():
        assert torch.equal(tensor, second.state_dict()[name])


def test_equal_weights_and_metadata_give_equal_bytes_whatever_the_order_of_keys() -> None:
    first = pack_weights(make(0), {"a": "1", "b": "2", "c": "3"})
    assert first.data == pack_weights(make(0), {"c": "3", "b": "2", "a": "1"}).data
    assert first.sha256 != pack_weights(make(1), {"a": "1", "b": "2", "c": "3"}).sha256
    assert first.arch_hash == pack_weights(make(1)).arch_hash


def test_arch_hash_sees_names_shapes_and_dtypes() -> None:
    base = {"a": torch.zeros(2, 3)}
    assert arch_hash(base) == arch_hash({"a": torch.ones(2, 3)})
    for other in ({"b": torch.zeros(2, 3)}, {"a": torch.zeros(3, 2)}, {"a": torch.zeros(2, 3).double()}):
        assert arch_hash(base) != arch_hash(other)


def test_wrong_hash_and_cut_data_are_refused() -> None:
    packed = pack_weights(make(0))
    with pytest.raises(WeightsError, match="expected 00"):
        unpack_weights(packed.data, sha256="00")
    for size in (0, 5, len(packed.data) - 1):
        with pytest.raises(WeightsError, match="cut short"):
            unpack_weights(packed.data[:size])
    with pytest.raises(WeightsError, match="no wm_nodes metadata"):
        unpack_weights(save({"a": torch.zeros(1)}))


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (make(0, 5), r"0\.bias is float32\[4\], expected float32\[5\]"),
        (nn.Sequential(nn.Linear(3, 4)), r"1\.bias is unknown"),
        (nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.Linear(4, 1)), r"2\.bias is missing"),
        (make(0).double(), r"0\.bias is float32\[4\], expected float64\[4\]"),
    ],
)
def test_another_architecture_names_the_first_difference_and_changes_nothing(target: nn.Module, message: str) -> None:
    before = {name: tensor.clone() for name, tensor in target.state_dict().items()}
    with pytest.raises(WeightsError, match=message):
        load_weights(target, pack_weights(make(1)).data)
    for name, tensor in target.state_dict().items():
        assert torch.equal(tensor, before[name])


def test_saved_file_holds_the_packed_bytes_and_leaves_no_temporary(tmp_path: Path) -> None:
    packed = save_weights(make(0), tmp_path / "new" / "p.safetensors")
    assert (tmp_path / "new" / "p.safetensors").read_bytes() == packed.data
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["p.safetensors"]


def test_failed_write_keeps_what_was_there_and_removes_the_temporary_file(tmp_path: Path) -> None:
    occupied = tmp_path / "occupied"
    occupied.mkdir()
    (occupied / "kept").write_bytes(b"old")
    with pytest.raises(OSError, match="occupied"):
        write_atomic(occupied, b"new")
    assert (occupied / "kept").read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["occupied"]
