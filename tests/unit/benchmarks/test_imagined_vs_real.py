"""The judge of the loops' clips against the simulator, on recordings and on what the model makes of their actions."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.judge.imagined_vs_real import FIRST_SEED, episode_ends
from wm_nodes.apps.cli import main
from wm_nodes.judge.backends.embedded import shipped_heads
from wm_nodes.judge.evidence.head import load_head
from wm_nodes.recording.episode_arrays import EpisodeArrays


def episodes(success: list[list[int]], lengths: list[int]) -> EpisodeArrays:
    """Episodes of two tasks, of which the second is the one that counts; nothing but what `ends` reads."""
    E, T = len(success), len(success[0]) - 1
    won = np.zeros((E, T + 1, 2), bool)
    won[..., 1], won[..., 0] = np.array(success, bool), True
    return EpisodeArrays(
        np.zeros((E, T + 1, 4, 4, 3), np.uint8), np.zeros((E, T + 1, 3), np.float32), np.zeros((E, T, 3), np.float32),
        np.zeros((E, T + 1, 1), np.float32), won, np.array(lengths), ("reach", "push_cube"), ("",) * E, ("",) * E,
        ("push_cube",) * E,
    )


def test_an_episode_ends_with_the_first_frame_of_success_or_when_it_is_over() -> None:
    success = [[0, 0, 1, 1, 0], [0, 0, 0, 0, 0], [0, 0, 0, 0, 1], [0, 0, 0, 1, 1]]
    last, succeeded = episode_ends(episodes(success, [4, 3, 4, 2]), "push_cube")
    assert last.tolist() == [2, 3, 4, 2] and succeeded.tolist() == [True, False, True, False]


@pytest.mark.rendering
def test_the_command_judges_recordings_and_dreams_of_the_same_actions(tmp_path: Path) -> None:
    report = tmp_path / "dreams.json"
    given = [str(tmp_path), "--episodes", "6", "--json", str(report)]
    assert main(["benchmark", "judge", "imagined-vs-real", *given]) == 0
    found = json.loads(report.read_text())
    shipped = load_head(shipped_heads()[1]).sha256[:12]
    assert found["judge"] == f"embedded:{shipped}" and found["first_seed"] == FIRST_SEED
    recorded, imagined = found["agreement"]
    assert (recorded["kind"], imagined["kind"]) == ("recorded", "imagined")
    for row in (recorded, imagined):
        assert row["n"] == 6 and row["judged"] + sum(row["kind"] in reason for reason in found["silent"]) <= 6
        assert row["low"] <= row["accuracy"] <= row["high"]
    assert 0 <= found["done_signal"]["accuracy"] <= 1 and found["machine"]["processor"]
