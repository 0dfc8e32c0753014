"""Nodes fork from a process that has not started CUDA: its imports do not, and it does not fork where one does."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from wm_nodes.launching.fork_server import CUDA_RUNS, ForkServer, ForkServerError
from wm_nodes.launching.runner import preloaded
from wm_nodes.launching.scenarios import SCENARIOS, build_graph, parse_arguments

GUARDED = """
import importlib, sys
import torch

def start_cuda(*arguments, **more):
    raise AssertionError("an import has asked for a GPU")

for name in ("_lazy_init", "init", "is_available", "device_count", "current_device", "is_bf16_supported"):
    setattr(torch.cuda, name, start_cuda)
for name in sys.argv[1:]:
    importlib.import_module(name)
print("imported", len(sys.argv) - 1)
"""


def imported_with_cuda_guarded(modules: list[str]) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([sys.executable, "-c", GUARDED, *modules], capture_output=True, text=True, check=False)


def test_no_module_that_is_imported_before_nodes_fork_asks_for_a_gpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = dict.fromkeys(("run_dir", "model_dir", "bag_uri", "video_model_dir", "context_bags"), str(tmp_path))
    modules = set[str]()
    for scenario, about in SCENARIOS.items():
        given = {name: value for name, value in (values | {"num_envs": "1"}).items() if name in about.arguments}
        modules |= {*preloaded(build_graph(scenario, parse_arguments(scenario, given)))}
    assert {"wm_nodes.nodes.policy_node", "wm_nodes.nodes.learner_node", "wm_nodes.nodes.video_model_node"} <= modules
    found = imported_with_cuda_guarded(sorted(modules))
    assert found.returncode == 0 and f"imported {len(modules)}" in found.stdout, found.stderr[-2000:]
    (tmp_path / "greedy.py").write_text("import torch\nGPU = torch.cuda.is_available()\n")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    assert "an import has asked for a GPU" in imported_with_cuda_guarded(["greedy"]).stderr


@pytest.mark.parametrize("started", [True, False])
def test_a_server_in_which_cuda_runs_says_so_and_does_not_fork(tmp_path: Path, started: bool) -> None:
    (tmp_path / "greedy.py").write_text(f"import torch\ntorch.cuda._initialized = {started}\n")
    (tmp_path / "node.py").write_text("print('node runs')\n")
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    server = ForkServer(sys.executable, ["greedy"], environment)
    output = tmp_path / "node.log"
    try:
        with output.open("ab") as file:
            if started:
                for _ in range(2):
                    with pytest.raises(ForkServerError, match="does not answer"):
                        server.start(["node"], environment, file.fileno())
            else:
                assert server.start(["node"], environment, file.fileno())[1].result(20) == 0
    finally:
        server.close()
    assert output.read_text() == (CUDA_RUNS if started else "node runs\n")
