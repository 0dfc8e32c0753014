"""Several learner processes: what they talk by, and which GPU is whose."""

import pytest
import torch
import torch.distributed as dist

from wm_nodes.core.device import DeviceError
from wm_nodes.training.ranks import join, own_device


@pytest.fixture
def joined(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The backends of the groups joined by rank 1 of 2, on a machine of two GPUs."""
    found: list[str] = []
    monkeypatch.setattr(dist, "init_process_group", lambda backend, **_: found.append(backend))
    monkeypatch.setattr(dist, "get_rank", lambda: 1)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("LOCAL_RANK", "1")
    return found


def test_ranks_under_torchrun_talk_by_gloo_and_one_process_joins_nothing(
    joined: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What they send is host memory, which nccl refuses."""
    ranks = join()
    assert (ranks.rank, ranks.size, joined) == (1, 2, ["gloo"])
    monkeypatch.delenv("WORLD_SIZE")
    assert (join("cuda").size, joined) == (1, ["gloo"])


@pytest.mark.parametrize("device", ["cuda", "cuda:0", "auto"])
def test_ranks_on_gpus_send_their_gradients_by_nccl_and_the_rest_by_gloo(joined: list[str], device: str) -> None:
    join(device)
    assert joined == ["cpu:gloo,cuda:nccl"]


def test_each_rank_has_the_gpu_of_its_number_unless_the_setting_has_one(
    joined: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert own_device("cuda") == own_device("auto") == torch.device("cuda", 1)
    assert own_device("cuda:0") == torch.device("cuda", 0) and own_device("cpu") == torch.device("cpu")
    monkeypatch.setenv("LOCAL_RANK", "2")
    with pytest.raises(DeviceError, match="device is cuda:2, but the GPUs here are cuda:0 to cuda:1"):
        own_device("cuda")
    monkeypatch.delenv("LOCAL_RANK")
    assert own_device("cuda") == torch.device("cuda", 0)
