"""Models compute in bfloat16 where the device has it; a GPU without it is named once, and computes in float32."""

from collections.abc import Iterator
from contextlib import nullcontext

import pytest
import torch

from wm_nodes.world_model.precision import _gpu_has_bfloat16, compute_context


@pytest.fixture(autouse=True)
def asked_anew() -> Iterator[None]:
    _gpu_has_bfloat16.cache_clear()
    yield
    _gpu_has_bfloat16.cache_clear()


@pytest.mark.parametrize("fast", [True, False])
def test_a_gpu_without_bfloat16_computes_in_float32_and_is_named_once(
    fast: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = list[bool]()
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: asked.append(fast) or fast)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "Old Card")
    monkeypatch.setattr(torch, "autocast", lambda kind, dtype: (kind, dtype))
    contexts = [compute_context(torch.device("cuda", 0)) for _ in range(3)]
    if fast:
        assert contexts == [("cuda", torch.bfloat16)] * 3
    else:
        assert all(isinstance(context, nullcontext) for context in contexts)
    assert isinstance(compute_context(torch.device("cuda", 0), exact=True), nullcontext)
    warning = "warning: cuda:0 (Old Card) has no bfloat16; models compute in float32 there\n"
    assert asked == [fast] and capsys.readouterr().err == ("" if fast else warning)
