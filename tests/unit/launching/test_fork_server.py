"""Nodes fork from a process that has not started CUDA: its imports do not, and it does not fork where one does."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from wm_nodes.launching import fork_server
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


@pytest.mark.slow
def test_no_module_that_is_imported_before_nodes_fork_asks_for_a_gpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = dict.fromkeys(("run_dir", "model_dir", "bag_uri", "video_model_dir", "context_bags"), str(tmp_path))
    modules = set[str]()
    for scenario, about in SCENARIOS.items():
        more = values | {"num_envs": "1", "seed": "0"}
        given = {name: value for name, value in more.items() if name in about.arguments}
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


@pytest.mark.slow
def test_a_node_that_came_too_late_is_ended_and_the_next_ones_are_not_taken_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a crowded machine; a killed node was once never noticed, because another one was watched in its place."""
    (tmp_path / "slow.py").write_text("import time\ntime.sleep(4)\n")
    (tmp_path / "node.py").write_text(
        "import os, sys, time\nprint(sys.argv[1], os.getpid(), flush=True)\ntime.sleep(60)\n"
    )
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    server = ForkServer(sys.executable, ["slow"], environment)
    try:
        with (tmp_path / "late.log").open("ab") as late, (tmp_path / "node.log").open("ab") as log:
            monkeypatch.setattr(fork_server, "ANSWER_S", 1.0)
            with pytest.raises(ForkServerError, match="does not answer"):
                server.start(["node", "late"], environment, late.fileno())
            monkeypatch.setattr(fork_server, "ANSWER_S", 60.0)
            pid, end = server.start(["node", "next"], environment, log.fileno())
        while not (said := (tmp_path / "node.log").read_text().split()):
            time.sleep(0.05)
        assert said == ["next", str(pid)]
        os.kill(pid, signal.SIGKILL)
        assert end.result(20) == -signal.SIGKILL
        deadline = time.monotonic() + 20  # a killed process needs the processor to end, too
        for word in (tmp_path / "late.log").read_text().split()[1:]:
            while Path(f"/proc/{word}").exists():
                assert time.monotonic() < deadline, f"the node that came too late still runs, as {word}"
                time.sleep(0.05)
    finally:
        server.close()
