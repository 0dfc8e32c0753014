"""The device suite at toy size: what it writes, and what it does when time, memory or patience end. Never how fast."""

import json
import math
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pretended_device import Device

from benchmarks.speed.device import DeviceSpeed, all_points
from benchmarks.speed.device_agreement import COMPARED, FLOAT32, trajectory
from benchmarks.speed.device_models import Models
from benchmarks.speed.device_suite import CPU_PLAN, GPU_PLAN, SHIPPED, ModelSize, Plan, Point, Stopwatch, Suite
from wm_nodes.apps.cli import main
from wm_nodes.policy_rl.factories import models_of

TINY = ModelSize("tiny", "smoke", (64,))
TOY = Plan(
    models=(TINY,), envs=(4, 8), loop_envs=(4,), trained=(TINY,), batch_shares=(0.5,),
    agreement_envs=4, num_steps=3, iterations=1, captured=False, threads=1, seconds=0.01,
)
CPU = torch.device("cpu")
GROUPS = {"agreement", "models", "imagination", "training"}


@pytest.fixture(autouse=True)
def leave_nothing() -> Iterator[None]:
    """Tensors of a pretended device are of no use after the test, whose threads end with it, too."""
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)
    models_of.cache_clear()


def run(tmp_path: Path, plan: Plan, device: str = "cpu") -> tuple[int | None, dict[str, Any]]:
    file = tmp_path / "speed.json"
    code = DeviceSpeed(device=device, plan=plan, json=file, command="wm benchmark device-speed").run()
    return code, json.loads(file.read_text())


def check_numbers(found: dict[str, Any]) -> None:
    for group in GROUPS:
        for row in found[group]:
            assert row["unit"] and row["peak_mib"] is not None
            if group not in ("models", "agreement"):
                assert row["n"] >= 1 and 0 < row["p10"] <= row["median"] <= row["p90"] < math.inf


@pytest.mark.slow
def test_every_point_is_in_the_file_with_its_spread_and_the_cpu_is_not_taken_for_a_gpu(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, found = run(tmp_path, TOY)
    assert code == 0 and found["state"] == "finished" and found["skipped"] == []
    check_numbers(found)
    assert all(row[f"{name}_largest"] == 0 for row in found["agreement"] for name in COMPARED)
    ways = [(row["envs"], row["way"]) for row in found["imagination"]]
    assert ways == [(4, "loop over host arrays"), (4, "eager"), (8, "eager")]
    assert found["note"] == "nothing was measured on a GPU" and found["machine"]["device"] == "cpu"
    assert found["configuration"]["num_steps"] == 3 and found["command"] == "wm benchmark device-speed"
    assert [row["trained"] for row in found["training"]] == ["tokenizer", "action model"]
    shown = capsys.readouterr().out
    assert "nothing was measured on a GPU" in shown and "imagined steps/s" in shown


@pytest.mark.slow
def test_on_a_device_all_is_measured_and_a_graph_that_cannot_be_captured_is_never_reported_as_one(
    tmp_path: Path, device: Device
) -> None:
    code, found = run(tmp_path, replace(TOY, captured=True), device.name)
    check_numbers(found)
    assert found["note"] == "" and found["machine"]["device"].startswith("cuda:0")
    float32, _, *captured = found["agreement"]
    assert float32["latents_largest"] < 1e-3 and float32["terminated_equal"] > 0.9
    ways = {row["way"] for row in found["imagination"]}
    if device.counts is None:
        assert code == 0 and "captured" in ways and captured[0]["equal_columns"] == captured[0]["columns"]
        return
    assert code == 1 and ways == {"eager", "loop over host arrays"} and captured == []
    assert len(found["skipped"]) == 3 and all("CUDA" in left["reason"] for left in found["skipped"])


def test_rollouts_that_differ_are_seen_to_differ(tmp_path: Path) -> None:
    model = Models("cpu", 0, tmp_path).at(SHIPPED, 64)
    other = replace(model, config=model.config.model_copy(update={"seed": 1}))
    first, again, second = (trajectory(one, TOY, FLOAT32, "cpu") for one in (model, model, other))
    for name in COMPARED:
        assert first[name].shape[:2] == (3, 4) and torch.equal(first[name], again[name])
        assert not torch.equal(first[name], second[name])


def test_what_would_begin_after_the_time_is_left_out_and_listed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, found = run(tmp_path, replace(TOY, minutes=0.0))
    assert code == 0 and not any(found[group] for group in GROUPS)
    assert {left["reason"] for left in found["skipped"]} == {"the 0 minutes were over"}
    assert "imagination: tiny, 64 px, 4 environments, eager" in [left["point"] for left in found["skipped"]]
    assert "left out (the 0 minutes were over)" in capsys.readouterr().out


@pytest.mark.slow
def test_ctrl_c_keeps_what_was_measured(tmp_path: Path) -> None:
    file = tmp_path / "speed.json"
    program = "import sys; from wm_nodes.apps.cli import main; sys.exit(main(sys.argv[1:]))"
    words = ["benchmark", "device-speed", "--device", "cpu", "--json", str(file)]
    process = subprocess.Popen([sys.executable, "-uc", program, *words], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for line in process.stdout:
        if "agreement: " in line:
            process.send_signal(signal.SIGINT)
            break
    rest = process.stdout.read()
    assert process.wait() == 130 and f"written to {file}" in rest
    found = json.loads(file.read_text())
    assert found["state"] == "interrupted" and found["agreement"][0]["terminated_equal"] == 1
    assert {left["reason"] for left in found["skipped"]} == {"interrupted"}


def rows(count: int) -> Point:
    """A point with so many rows."""

    def measure(watch: Stopwatch) -> list[float]:
        return watch.repeats(lambda: np.ones((count, 2**20)).sum())

    return Point("imagination", {"model": "tiny", "envs": count}, "steps/s", measure)


def test_a_point_that_runs_out_of_memory_or_fails_does_not_end_the_others() -> None:
    def full(watch: Stopwatch) -> list[float]:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory")

    def faulty(watch: Stopwatch) -> list[float]:
        return watch.repeats(lambda: torch.ones(2) @ torch.ones(3))

    suite = Suite(CPU, TOY, lambda line: None)
    suite.run([Point("training", {"envs": 4}, "ms", full)])
    assert suite.skipped == [{"point": "training: 4 environments", "reason": "the memory of cpu is too small"}]
    assert not suite.failed
    suite.run([Point("training", {"envs": 4}, "ms", faulty), rows(1)])
    assert suite.failed and "faulty" in suite.skipped[1]["traceback"] and len(suite.results["imagination"]) == 1


@pytest.mark.parametrize("plan", [CPU_PLAN, GPU_PLAN])
def test_points_have_names_of_their_own_and_cost_nothing_until_they_are_measured(plan: Plan, tmp_path: Path) -> None:
    names = [point.name for point in all_points(plan, Models("cuda", 0, tmp_path), "cuda")]
    assert len(set(names)) == len(names) > 10 and not any(tmp_path.iterdir())


def test_a_gpu_that_is_not_there_is_one_line_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "device-speed", "--device", "cuda:99"]) == 2
    error = capsys.readouterr().err
    assert "cuda:99" in error and error.count("\n") == 1


def test_a_file_that_cannot_be_written_is_found_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert main(["benchmark", "device-speed", "--device", "cpu", "--json", str(tmp_path / "file" / "speed.json")]) == 2
    shown = capsys.readouterr()
    assert "agreement" not in shown.out and str(tmp_path / "file") in shown.err
