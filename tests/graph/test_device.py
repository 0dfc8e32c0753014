"""Nodes on a device that is not there: configure fails with one line, and no trace."""

from pathlib import Path

import pytest
import torch
from graph.harness import Graph

from wm_nodes.config.load import load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.policy_rl.initial_policy import STARTS

MODEL = shipped_model("push_cube")
PARAMS = {
    "policy": {},
    "learner": {},
    "environment": {"backend": "world_model", "num_envs": 2, "starts_file": MODEL / STARTS},
    "reward_evaluator": {"reward": "endogenous"},
}


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_nodes_that_compute_refuse_a_gpu_that_is_not_there(domain: int, tmp_path: Path) -> None:
    graph = Graph(domain, tmp_path / "run", load_config("smoke", {"device": "cuda"}))
    try:
        for node, params in PARAMS.items():
            graph.start(node, model_dir=MODEL, **params)
        for node in PARAMS:
            assert graph.processes[f"/wm/{node}"].wait(60) == 1
            log = graph.log(f"/wm/{node}")
            assert f"configure failed: device is cuda, but torch {torch.__version__} sees no GPU; set device" in log
            assert log.count("\n") == 1, log
    finally:
        graph.stop()
