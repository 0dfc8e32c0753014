"""What a resumed run finds: kept evaluations, shares of the updates, joined metrics."""

import json
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from wm_nodes.apps.policy_run import cached_success
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
