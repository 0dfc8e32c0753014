"""What a resumed run finds: kept evaluations, shares of the updates, joined metrics."""

import json
import shlex
from contextlib import closing, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from wm_nodes.apps import policy_run, train_policy
from wm_nodes.apps.policy_run import RunContext, TrainingStart, WaitingGraph, cached_success, is_trained, train_round
from wm_nodes.config.load import load_config
from wm_nodes.policy_rl.model_refresh import round_config, split_updates
from wm_nodes.reports.summary import SuccessRate, Summary
from wm_nodes.reports.tables import ROUND_COLUMNS, round_rows
from wm_nodes.training.metrics import MetricsWriter, join_metrics, read_metrics


def test_an_evaluation_is_kept_until_it_is_of_something_else(tmp_path: Path) -> None:
    path, calls = tmp_path / "evaluations" / "real_before.json", list[str]()

    def measure(name: str) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        calls.append(name)
        return np.array([True, False, name == "trained"])

    for policy in ("weak", "weak", "trained"):
        found = cached_success(path, {"policy_sha256": policy}, lambda policy=policy: measure(policy))
        assert found.tolist() == [True, False, policy == "trained"]
    assert calls == ["weak", "trained"]
    assert json.loads(path.read_text())["success"] == [1, 0, 1]


class Operator:
    """A graph that trains at once, and is interrupted while it measures the trained policy for the first time."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.trainings, self.interrupts = folder, 0, True
        self.write(0)

    def write(self, updates: int) -> None:
        for name in ("checkpoints", "policies"):
            (self.folder / name).mkdir(exist_ok=True)
        progress = {"updates": updates, "version": 1 + updates, "samples": 100 * updates}
        (self.folder / "checkpoints" / "learner.json").write_text(json.dumps({"progress": progress}))
        (self.folder / f"policies/policy_{1 + updates:06d}.safetensors").write_text(str(updates))

    def train(self, updates: int, on_progress: object) -> Any:
        self.trainings += 1
        self.write(updates - 1)  # as the exploit meter ends it
        return SimpleNamespace(message="the meter says so")

    def evaluate(self, *, label: str, **settings: Any) -> Any:
        if label == "after" and self.interrupts:
            self.interrupts = False
            raise KeyboardInterrupt
        return np.array([True, False])


def test_a_training_whose_policy_was_still_to_be_measured_is_not_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weak = tmp_path / "weak.safetensors"
    weak.write_text("weak")
    operator, config, bags = Operator(tmp_path), load_config("smoke"), iter(["first", "second"])
    runner: Any = SimpleNamespace(
        activate=lambda seconds: None, environment={}, check=lambda: None, stop=lambda: None, close=lambda: None
    )
    monkeypatch.setattr(policy_run, "start_graph", lambda job, start: WaitingGraph(runner, Path(next(bags))))
    monkeypatch.setattr(policy_run, "GraphClient", lambda alive: nullcontext(operator))
    said: Any = lambda text: None  # noqa: E731
    job = RunContext(config, tmp_path, tmp_path / "starts", said)
    start = TrainingStart(tmp_path, tmp_path / "model", weak, config, tmp_path / "starts")
    with pytest.raises(KeyboardInterrupt):
        train_round(job, start)
    assert not is_trained(start)
    trained = train_round(job, start)
    assert operator.trainings == 1, "the meter has ended it, and more updates may follow no more"
    assert (trained.bag, trained.stopped) == ("first", "the meter says so")
    assert trained.samples_per_s > 0 and not trained.resumed
    assert is_trained(start) and train_round(job, start) == trained


def test_the_command_that_trains_again_names_the_model_and_a_bag_of_a_part_is_told(tmp_path: Path) -> None:
    operator: Any = Operator(tmp_path)
    operator.write(1)
    said: Any = lambda text: None  # noqa: E731
    config, starts = load_config("smoke"), tmp_path / "starts"
    job, weak = RunContext(config, tmp_path, starts, said), tmp_path / "weak.safetensors"
    start = TrainingStart(tmp_path, tmp_path / "model", weak, config, starts)
    assert policy_run._make_updates(operator, job, start, "bag").resumed
    words = shlex.split(train_policy._replay(tmp_path / "a run", "/a run/bag", tmp_path / "own model", weak))
    given = dict(word.split(":=") for word in words[2:])
    assert given["model_dir"] == str(tmp_path / "own model") and given["preset"] == str(tmp_path / "a run/config.yaml")


def test_the_updates_are_split_over_the_rounds_remainder_first() -> None:
    assert split_updates(24, 1) == [24] and split_updates(0, 1) == [0]
    assert split_updates(8, 3) == [3, 3, 2]
    with pytest.raises(ValueError, match="fewer than 3 rounds"):
        split_updates(2, 3)


def test_every_round_but_the_first_has_a_seed_of_its_own() -> None:
    config = load_config("smoke")
    rounds = [round_config(config, number, 2) for number in (1, 2, 3)]
    assert rounds[0].seed == config.seed and len({found.seed for found in rounds}) == 3
    assert {found.ppo.updates for found in rounds} == {2}


def test_metrics_of_consecutive_trainings_are_counted_on(tmp_path: Path) -> None:
    folders = [tmp_path / "1", tmp_path / "2"]
    for folder in folders:
        with closing(MetricsWriter(folder, tensorboard=False)) as writer:
            writer.write("exploit_meter", 0, {"precision": 1.0})
            for step in (1, 2):
                writer.write("ppo", step, {"loss_policy": 0.5})
    for _ in range(2):
        join_metrics(folders, tmp_path)
        assert [line["step"] for line in read_metrics(tmp_path, "ppo")] == [1, 2, 3, 4]
        assert [line["step"] for line in read_metrics(tmp_path, "exploit_meter")] == [0, 2]


def test_the_table_of_rounds_says_what_became_of_the_refreshed_model() -> None:
    rate = {"successes": 1, "episodes": 4, "rate": 0.25}
    rounds = [
        {"number": 1, "updates": 3, "imagined_before": rate, "imagined": rate, "real": rate, "verdict": verdict}
        for verdict in ({"accepted": False, "reason": "worse: done recall"}, {})
    ]
    any_rate = SuccessRate(1, 4)
    summary = Summary("push_cube", "smoke", 0, any_rate, any_rate, any_rate, any_rate, 1.0, "", rounds=rounds)
    rows = round_rows(summary)
    assert len(rows[0]) == len(ROUND_COLUMNS)
    assert rows[0][-1] == "old one kept: worse: done recall" and rows[1][-1] == ""
    assert rows[0][4] == "25.0 % (1/4)"
