"""Memory and time of public video models, at toy size: what is written, never how fast."""

import json
from pathlib import Path

import pytest
import torch

for _name in ("diffusers", "peft"):
    pytest.importorskip(_name)

from benchmarks.video_rl import public_size  # noqa: E402
from benchmarks.video_rl.public_size import SIZES, paper_iteration  # noqa: E402
from wm_nodes.apps.cli import main  # noqa: E402


def test_a_model_that_does_not_fit_is_a_row_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measure = public_size.measure_size

    def small(size: public_size.Size, *rest: object) -> dict[str, object]:
        if size is SIZES["tiny-wan"]:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return measure(size, *rest)  # type: ignore[arg-type]

    path = tmp_path / "size.json"
    call = ["benchmark", "public-size", "--models", "tiny-wan", "tiny-cosmos", "--steps", "3", "--json", str(path)]
    monkeypatch.setattr(public_size, "measure_size", small)
    assert main(call) == 0
    failed, found = json.loads(path.read_text())["rows"]
    assert failed == {
        "model": "tiny-wan", "frames": 9, "steps": 3, "error": "OutOfMemoryError: CUDA out of memory"
    }
    assert found["latents"] == [4, 3, 4, 4] and found["tokens"] == 12 and found["given"] == 1
    assert found["transitions"] == 2 and found["train_gib"] is None, "there is no GPU"
    assert found["rollout_s_per_step_clip"] > 0 and found["trained_parameters"] > 0
    monkeypatch.setattr(public_size, "measure_size", measure)
    assert main(call) == 0
    kept, made = json.loads(path.read_text())["rows"]
    assert kept == found and made["model"] == "tiny-wan" and made["given"] == 0, "what failed is measured again"


def test_an_iteration_of_the_preset_has_4096_steps_and_2048_transitions() -> None:
    """16 contexts of 16 clips of 16 steps; 8 of the 15 stochastic steps of 8 kept clips of each, twice."""
    found = paper_iteration(3600.0, 1.0)
    assert found["computed_rollout_h"] == 4096
    assert found["computed_train_h"] == pytest.approx(2048 / 3600)


@pytest.mark.parametrize(("name", "billions"), [
    ("wan2.1-t2v-1.3b", 1.42), ("wan2.2-ti2v-5b", 5.0), ("cosmos-predict2.5-2b", 2.07),
])
def test_the_sizes_are_those_of_the_published_models(name: str, billions: float) -> None:
    import diffusers

    size = SIZES[name]
    kind = diffusers.CosmosTransformer3DModel if size.cosmos else diffusers.WanTransformer3DModel
    with torch.device("meta"):
        network = kind(**size.settings)
    assert sum(p.numel() for p in network.parameters()) / 1e9 == pytest.approx(billions, rel=0.01)
