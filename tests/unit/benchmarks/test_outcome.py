"""The outcome benchmark on recorded simulator episodes, with the shipped model, its reader and the shipped judge."""

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.video_rl.outcome import METRICS, AsWritten, kept_weights, weights_name
from wm_nodes.apps.cli import main
from wm_nodes.config.load import load_config, load_video_config
from wm_nodes.config.seed_ranges import HELDOUT
from wm_nodes.environments.record import collect_plan, scripted_plan

ARMS = ["CPS 0.4", "signed FM, ODE", "CPS 0.4, judge robot", "CPS 0.4, execution and outcome"]
DONE = {f"{name}{after}" for name in ("accepted", "execution_success") for after in ("", "_executed")}


def rows_of(path: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = json.loads(path.read_text())["rows"]
    return rows


@pytest.mark.slow
def test_the_command_trains_measures_the_kept_weights_and_goes_on_where_its_file_stops(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = load_config("cpu", {"task": "push_cube", "data.num_workers": 1})
    (bag,) = collect_plan(scripted_plan(scene, 3, HELDOUT), scene, tmp_path / "bags")
    path, kept = tmp_path / "found.json", tmp_path / "weights"
    call = [
        "benchmark", "outcome", "--context-bags", str(bag), "--heldout-bags", str(bag), "--iterations", "2",
        "--eval-contexts", "2", "--weights", str(kept), "--measure-every", "1", "--json", str(path),
        "--samplers", *ARMS,
    ]
    assert main([*call, "--seeds", "0"]) == 0
    first = rows_of(path)
    assert [row["sampler"] for row in first] == ARMS
    for row in first:
        assert len(row["evaluations"]) == 2
        assert [int(buffers) for buffers in row["measured"]] == [0, 1, 2] and row["weights"].keys() == {"1", "2"}
        assert all(set(found) == {*METRICS, *DONE} for found in row["measured"].values())
        assert row["measured"]["0"] == first[0]["measured"]["0"], "all arms begin with the same model"
    assert first[0]["plan"]["rewards"] == [["outcome", 1.0]] and first[2]["plan"]["rewards"] == [["agent", 1.0]]
    assert first[3]["plan"]["rewards"] == [["execution", 1.0], ["outcome", 0.3]]
    names = ("CPS_0.4", "signed_FM_ODE", "CPS_0.4_judge_robot", "CPS_0.4_execution_and_outcome")
    files = {f"{name}_0_{buffers}.safetensors" for name in names for buffers in (1, 2)}
    assert {file.name for file in kept.iterdir()} == files
    assert len({file.read_bytes() for file in kept.iterdir()}) == 8, "two arms are the same training"
    assert kept_weights(kept, first[0], 2) == kept / "CPS_0.4_0_2.safetensors"
    assert (tmp_path / "found_proxy.png").is_file()
    assert "executed_success" in METRICS and "metrics that nothing trained on" in capsys.readouterr().out
    assert main([*call[:-len(ARMS)], ARMS[0], "--seeds", "0", "1"]) == 0
    rows = rows_of(path)
    assert rows[:4] == first and [(row["sampler"], row["seed"]) for row in rows[4:]] == [(ARMS[0], 1)]


def test_weights_that_another_training_left_under_the_same_name_are_not_measured(tmp_path: Path) -> None:
    path = tmp_path / weights_name("CPS 0.4", 0, 2)
    row: dict[str, Any] = {"sampler": "CPS 0.4", "seed": 0, "weights": {"2": hashlib.sha256(b"own").hexdigest()}}
    path.write_bytes(b"own")
    assert kept_weights(tmp_path, row, 2) == path
    path.write_bytes(b"another")
    for some in (row, {**row, "weights": {}}, {**row, "seed": 1}):
        with pytest.raises(ValueError, match="is not what the training of this row left; take another --json file"):
            kept_weights(tmp_path, some, 2)


def test_as_written_is_the_preset_of_the_paper_but_for_what_a_small_model_needs() -> None:
    paper = load_video_config("paper")
    mix, small = {"step_fraction"}, {"learning_rate", "micro_batch"}
    for trial in AsWritten(context_bags=(), heldout_bags=()).trials():
        sampler, plan = trial.sampler, trial.plan
        changed = small | (mix if sampler.name.startswith("Mix") or sampler.name.endswith("window") else set())
        changed |= {"logprob_weight"} if sampler.name.endswith(", cps") else set()
        assert sampler.grpo.model_dump(exclude=changed) == paper.grpo.model_dump(exclude=changed), sampler.name
        kept = {"num_steps", "shift", "cfg"}
        assert sampler.rollout.model_dump(include=kept) == paper.rollout.model_dump(include=kept), sampler.name
        assert (plan.contexts, plan.group_size) == (paper.groups.contexts, paper.groups.group_size)
        assert sampler.shared_noise == paper.groups.shared_noise
    assert AsWritten(context_bags=(), heldout_bags=()).trials()[0].sampler.rollout.sampler == paper.rollout.sampler
