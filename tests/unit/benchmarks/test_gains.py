"""The headline number of the paper's Table 1 from its cells."""

import pytest

from benchmarks.environments.policies import mean_gain

TASKS = ("pick and place", "push", "pull", "move to aim")
IND = {
    ("MLP", "SFT"): (12.0, 84.5, 57.7, 35.8), ("MLP", "simulator"): (85.0, 98.5, 64.2, 87.6),
    ("MLP", "world model"): (86.7, 98.7, 65.2, 88.1), ("OpenVLA", "SFT"): (22.5, 94.4, 73.5, 67.5),
    ("OpenVLA", "simulator"): (92.5, 97.7, 89.1, 92.5), ("OpenVLA", "world model"): (95.5, 98.4, 91.4, 94.6),
}
OOD = {
    ("MLP", "SFT"): (3.5, 13.3, 10.2, 10.6), ("MLP", "simulator"): (32.1, 15.6, 15.5, 42.9),
    ("MLP", "world model"): (74.2, 87.3, 51.3, 72.0), ("OpenVLA", "SFT"): (47.5, 84.0, 12.5, 24.5),
    ("OpenVLA", "simulator"): (54.5, 93.0, 39.6, 41.5), ("OpenVLA", "world model"): (84.1, 97.5, 85.8, 82.1),
}
"""RoboScape-R, Table 1: success, %, in training scenes and outside of them."""


def cells(table: dict[tuple[str, str], tuple[float, ...]], *policies: str) -> dict[tuple[str, str, str], float]:
    return {
        (policy, training, task): rate
        for (policy, training), row in table.items() if policy in policies for task, rate in zip(TASKS, row)
    }


def test_the_papers_cells_give_the_papers_headline() -> None:
    both = cells(OOD, "MLP", "OpenVLA")
    assert mean_gain(both, "world model", "simulator") == pytest.approx(37.45, abs=0.0051)
    assert mean_gain(cells(OOD, "MLP"), "world model", "simulator") == pytest.approx(44.68, abs=0.0051)
    assert mean_gain(cells(OOD, "OpenVLA"), "world model", "simulator") == pytest.approx(30.23, abs=0.0051)
    assert mean_gain(both, "world model", "SFT") == pytest.approx(53.5, abs=0.05)
    assert mean_gain(cells(IND, "MLP", "OpenVLA"), "world model", "simulator") == pytest.approx(1.44, abs=0.0051)


def test_a_cell_without_its_fellow_is_an_error() -> None:
    some = cells(OOD, "MLP")
    del some["MLP", "simulator", "pull"]
    with pytest.raises(ValueError, match=r"different cells: \[\('MLP', 'pull'\)\]"):
        mean_gain(some, "world model", "simulator")
    with pytest.raises(ValueError, match="none"):
        mean_gain({}, "world model", "simulator")
