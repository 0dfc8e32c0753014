"""Several learner processes: what they talk by."""

import pytest
import torch.distributed as dist

from wm_nodes.training.ranks import join


def test_ranks_under_torchrun_talk_by_gloo_and_one_process_joins_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """What they send is host memory, which nccl refuses."""
    joined: list[str] = []
    monkeypatch.setattr(dist, "init_process_group", lambda backend, **_: joined.append(backend))
    monkeypatch.setattr(dist, "get_rank", lambda: 1)
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert (join().size, joined) == (1, [])
    monkeypatch.setenv("WORLD_SIZE", "2")
    ranks = join()
    assert (ranks.rank, ranks.size, joined) == (1, 2, ["gloo"])
