"""Memory and arithmetic of OpenVLA, counted without weights."""

import json
from pathlib import Path

import pytest
import torch
from tiny_openvla import TEXT, TOWERS

pytest.importorskip("peft")

from benchmarks.environments import openvla_size
from benchmarks.environments.openvla_size import DINO, LLAMA_2, SIGLIP, checkpoint, published
from wm_nodes.apps.cli import main


def test_the_published_size_is_that_of_the_published_checkpoint() -> None:
    """7.54e9 with the last block and the pooling that are not used; see its model card."""
    with torch.device("meta"):
        _, tensors = checkpoint(LLAMA_2, (DINO, SIGLIP))
    assert sum(t.numel() for t in tensors.values()) / 1e9 == pytest.approx(7.54, rel=0.005)


def test_what_one_picture_costs_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(openvla_size, "LLAMA_2", TEXT)
    monkeypatch.setattr(openvla_size, "DINO", TOWERS[0])
    monkeypatch.setattr(openvla_size, "SIGLIP", TOWERS[1])
    path = tmp_path / "size.json"
    assert main(["benchmark", "openvla-size", "--json", str(path)]) == 0
    (row,) = json.loads(path.read_text(encoding="utf-8"))["rows"]
    policy = published(torch.device("cpu"), 0)
    trained = [p for p in policy.parameters() if p.requires_grad]
    assert row["trained"] == pytest.approx(sum(p.numel() for p in trained), rel=1e-4) and row["trained"] > 0
    assert row["weights_gib"] * 2**30 == pytest.approx(sum(p.nbytes for p in policy.parameters()), rel=1e-3)
    kept = sum(p.nbytes for p in policy.parameters()) / 2**30
    assert row["kept_for_backward_gib_per_picture"] > 0 and row["gradients_and_adam_gib"] < 3 * kept
    matrices = sum(p.numel() for p in policy.actor.language_model.model.parameters() if p.ndim == 2)
    sequence = openvla_size.PATCHES + openvla_size.PROMPT_TOKENS  # and action tokens
    assert row["forward_tflop_per_picture"] * 1e12 > 2 * matrices * sequence
    assert row["backward_tflop_per_picture"] > 0.8 * row["forward_tflop_per_picture"]
