"""The command that says what a judge is good for, against scripted servers, a real one and the embedded judge."""

import json
from pathlib import Path
from typing import Any

import pytest
from chat_server import ChatServer
from judge_server import serving
from tiny_vlm import save_tiny_vlm, transformers_serve

from wm_nodes.apps.cli import main


@pytest.mark.slow
def test_a_server_that_pays_everything_is_good_for_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(ChatServer(level=4)) as server:
        command = ["judge", "check", server.url, "--model", "judge", "--limit", "8", "--reads", str(tmp_path / "reads")]
        assert main([*command, "--json", str(tmp_path / "a.json")]) == 1
        shown, asked = capsys.readouterr().out, len(server.requests)
        assert "good enough for nothing: not for a reward (faults paid 100.0 %" in shown and "Table 2" in shown
        assert main(command) == 1 and len(server.requests) < 2 * asked, "kept answers are not asked again"
    numbers: dict[str, Any] = json.loads((tmp_path / "a.json").read_text())
    refused = numbers["schema"]["of"] - numbers["schema"]["count"]
    assert numbers["clips"] == 8 and refused == 16, "planning ends at level 3, and this server says 4: once per mode"
    assert numbers["label_mass"] == pytest.approx(1.0) and numbers["flips"] == {"count": 0, "of": 64}
    assert numbers["paid_faults"] == {"count": 4, "of": 4} and numbers["kept"]["count"] == numbers["kept"]["of"] > 0


def test_a_server_that_is_not_there_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["judge", "check", "http://127.0.0.1:9/v1", "--model", "judge", "--limit", "2"]) == 2
    assert "the judge does not answer" in capsys.readouterr().err


def test_the_embedded_judge_is_checked_by_the_same_limits(capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["judge", "check", "embedded", "--limit", "6"])
    shown = capsys.readouterr().out
    assert code == (0 if "good enough for a reward" in shown else 1) and "overall" in shown


@pytest.mark.slow
def test_a_real_server_without_schema_and_probabilities_gives_no_number(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("fastapi", reason="transformers serve needs fastapi and uvicorn of requirements/dev.txt")
    save_tiny_vlm(tmp_path, json.dumps({"evidence": "edges are soft", "frames": [0], "level": 3}))
    with transformers_serve(tmp_path) as url:
        assert main(["judge", "check", url, "--model", str(tmp_path), "--limit", "2"]) == 1
    shown = capsys.readouterr().out
    assert "2 ERROR" in shown and "gives no logprobs" in shown and "invalid answers 100.0 %" in shown
