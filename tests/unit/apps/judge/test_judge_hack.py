"""The command that tries to hack a judge: a server over HTTP, and the embedded judge on a recorded bag."""

import json
from pathlib import Path

import pytest
from clip_folders import write_clips
from judge_server import PickyServer, serving

from wm_nodes.apps.cli import main
from wm_nodes.judge.hacking.attack import PER_CLIP
from wm_nodes.judge.hacking.edits import PATTERNS


@pytest.mark.slow
def test_a_server_that_pays_everything_fails_is_drawn_and_is_not_asked_twice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_clips(tmp_path)
    with serving(PickyServer()) as server:
        command = ["judge", "hack", str(tmp_path), "--judge", server.url, "--judge-model", "judge", "--limit-clips",
                   "1", "--reads", str(tmp_path / "reads"), "--json", str(tmp_path / "hack.json")]
        assert main([*command, "--pictures", str(tmp_path / "paid")]) == 1
        out, asked = capsys.readouterr().out, len(server.requests)
        first = json.loads((tmp_path / "hack.json").read_text())
        assert main(command) == 1 and len(server.requests) == asked
    assert "physics: 100.0% of the grossly edited clips are still paid, limit 15%" in out and "benign" in out
    assert first == json.loads((tmp_path / "hack.json").read_text())
    assert first["clips"] == 1 and len(first["counts"]) == PER_CLIP and first["not_paid"] == []
    seen = {row["edit"] for row in first["counts"] if row["n"] and row["pattern"] in PATTERNS}
    assert {path.read_bytes()[:4] for path in (tmp_path / "paid").iterdir()} == {b"\x89PNG"}
    assert len(list((tmp_path / "paid").iterdir())) == len(seen)


def test_clips_that_are_not_paid_are_not_attacked_and_one_error_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_clips(tmp_path)
    with serving(PickyServer()) as server:
        command = ["judge", "hack", str(tmp_path), "--judge", server.url, "--judge-model", "judge"]
        assert main([*command, "--least", "1.1"]) == 2
        assert "the judge pays none of 2 clips unedited (2 x OK); give it clips" in capsys.readouterr().err
    assert main(["judge", "hack", str(tmp_path), "--limit", "2"]) == 2
    assert "--limit is a share from 0 to below 1, got 2.0" in capsys.readouterr().err
    assert main(["judge", "hack", str(tmp_path / "none"), "--judge", "embedded"]) == 2
    assert 'one line per clip, e.g. {"file": "a.mp4"' in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.rendering
def test_the_shipped_judge_holds_on_the_episodes_of_a_bag(tmp_path: Path) -> None:
    recorded = ["collect", str(tmp_path), "--tasks", "push_cube", "--episodes", "2", "--first-seed", "910000"]
    assert main([*recorded, "--data.behaviours", "{expert: 1.0}"]) in (0, None)
    found = tmp_path / "hack.json"
    attack = ["judge", "hack", str(tmp_path), "--judge", "embedded", "--limit", "0.3", "--json", str(found)]
    assert main(attack) == 0
    rows = json.loads(found.read_text())["counts"]
    assert len(rows) == PER_CLIP and sum(row["n"] for row in rows) > 0.9 * 2 * PER_CLIP
    physics = [row for row in rows if row["pattern"] == "physics" and row["step"] in (3, 4)]
    assert sum(row["n"] * row["share"] for row in physics) <= 0.15 * sum(row["n"] for row in physics)
    assert all(row["share"] == 1 for row in rows if row["pattern"] == "benign")
