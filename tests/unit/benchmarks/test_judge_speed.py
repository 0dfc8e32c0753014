"""The command that times the embedded judge: what it writes, and what it refuses. How fast it is, no test says."""

import json
from itertools import pairwise
from pathlib import Path

import pytest

from benchmarks.judge.speed import FRAMES, moving_clip
from wm_nodes.apps.cli import main
from wm_nodes.judge.backends.embedded import shipped_head
from wm_nodes.judge.evidence.head import load_head


def test_the_file_names_judge_command_and_machine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "speed.json"
    assert main(["benchmark", "judge", "speed", "--cores", "1", "--clips", "2", "--json", str(path)]) == 0
    found = json.loads(path.read_text())
    assert found["judge"] == load_head(shipped_head()).sha256
    assert found["command"] == f"wm benchmark judge speed --cores 1 --clips 2 --json {path}"
    assert (found["frames"], found["processes"], found["clips_each"]) == (25, 1, 2)
    assert found["clips_per_s"] == pytest.approx(1 / found["processor_s_per_clip"])
    assert found["clips_per_s_by_the_clock"] == pytest.approx(1 / found["wall_s_per_clip"])
    assert found["machine"]["processor"] in capsys.readouterr().out


def test_the_clip_moves_and_is_the_same_each_time() -> None:
    clip = moving_clip(3)
    assert clip.shape == (FRAMES, 96, 96, 3) and (clip == moving_clip(3)).all()
    assert all((one != other).any() for one, other in pairwise(clip))


def test_no_judge_and_no_clip_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "judge", "speed", str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["benchmark", "judge", "speed", "--clips", "0"])
    assert "'0' is no whole number from 1 on" in capsys.readouterr().err
