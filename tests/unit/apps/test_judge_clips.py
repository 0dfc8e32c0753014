"""The command that judges a folder of one's own clips, by a server over HTTP and by the embedded judge."""

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from chat_server import Fault
from clip_folders import write_clips
from judge_server import PickyServer, serving

from wm_nodes.apps.cli import main
from wm_nodes.apps.judge_clips import VERDICTS
from wm_nodes.config.shipped import shipped_model
from wm_nodes.judge.agent.types import clip_ref
from wm_nodes.judge.audit.reading import read_record
from wm_nodes.judge.clip_files import read_list

JUDGE = str(shipped_model("push_cube"))


def rows_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / VERDICTS).read_text().splitlines()]


def test_a_servers_verdicts_are_kept_audited_and_gone_on_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_clips(tmp_path)
    with serving(PickyServer()) as server:
        command = ["judge-clips", str(tmp_path), "--judge", server.url, "--judge-model", "judge"]
        assert main([*command, "--audit", str(tmp_path / "audit"), "--round", "3"]) == 0
        assert "2 clips (2 OK), mean reward 0." in capsys.readouterr().out
        rows, asked = rows_of(tmp_path), len(server.requests)
        assert [row["clip_id"] for row in rows] == ["a", "mine"] and all(0 < row["reward"] <= 1 for row in rows)
        assert all(isinstance(row["accepted"], bool) for row in rows)
        record = read_record(tmp_path / "audit")
        assert {evaluation.round_number for evaluation in record.judged()} == {3}
        assert [e.verdict.audit_id for e in record.judged() if e.verdict] == [row["audit_id"] for row in rows]
        with (tmp_path / VERDICTS).open("a") as file:
            file.write('{"torn')
        assert main(command) == 0 and len(server.requests) == asked, "judged before, so nobody is asked"
        server.down = True
        assert main([*command, "--mode", "benchmark"]) == 1 and "ERROR" in capsys.readouterr().out
        server.down = False
        assert main([*command, "--mode", "benchmark"]) == 0, "what the judge failed on is asked again"
    lines = (tmp_path / VERDICTS).read_text().splitlines()
    kept = [json.loads(line) for number, line in enumerate(lines) if number != 2]
    assert lines[2] == '{"torn' and [(row["mode"], row["status"]) for row in kept] == [
        ("reward", "OK"), ("reward", "OK"), *[("benchmark", "ERROR")] * 2, *[("benchmark", "OK")] * 2,
    ]


def test_another_question_is_asked_anew_and_a_verdict_of_before_is_kept_beside_it(tmp_path: Path) -> None:
    (first, second) = write_clips(tmp_path)
    cv2.imwrite(str(tmp_path / "end.png"), np.full((96, 96, 3), 90, np.uint8))
    with serving(PickyServer()) as server, serving(PickyServer()) as other:
        command = ["judge-clips", str(tmp_path), "--judge", server.url, "--judge-model", "judge"]
        assert main(command) == 0

        def asked(*more: str, **changed: Any) -> list[str]:
            """Which clips are judged again with other fields of the second one."""
            lines = [json.dumps(line) + "\n" for line in (first, {**second, **changed})]
            (tmp_path / "clips.jsonl").write_text("".join(lines))
            known = len(rows_of(tmp_path))
            assert main([*command, *more]) == 0
            return [row["clip_id"] for row in rows_of(tmp_path)[known:]]

        assert asked() == [] and asked(reference="end.png") == asked(goal="end.png") == asked(robot="xarm") == ["mine"]
        for settings in (
            ["--judge.extra_body", "{top_k: 3}"], ["--judge.max_images", "50"], ["--judge", other.url],
            ["--judge.max_reads", "50"], ["--judge.rubric", "robot_no_votes"], ["--judge.mode", "benchmark"],
        ):
            assert asked(*settings) == ["a", "mine"] and asked(*settings) == [], settings
        assert asked("--judge.concurrency", "1", "--judge.tries", "9") == asked(goal="end.png") == []
        old = [{**row, "key": f"{second['sha256']}  {second['instruction']}"} for row in rows_of(tmp_path)[:2]]
        (tmp_path / VERDICTS).write_text("".join(json.dumps(row) + "\n" for row in old))
        assert asked() == ["a", "mine"] and rows_of(tmp_path)[:2] == old, "of a version with another key"


class EchoingServer(PickyServer):
    """Cites the key that it was sent, its / escaped as JSON allows, in every evidence."""

    def _completion(self, body: dict[str, Any], fault: Fault | None) -> str:
        key = self.headers[-1]["authorization"].removeprefix("Bearer ").replace("/", r"\\/")
        return super()._completion(body, fault).replace("seen in frame 0", f"I was sent {key}")


def test_a_key_stands_in_no_file_and_extra_fields_of_the_configuration_reach_the_server(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WM_TEST_KEY", "ab/cd+ef/gh")
    write_clips(tmp_path)
    fields = {"chat_template_kwargs": {"enable_thinking": False}}
    (tmp_path / "my.yaml").write_text(f"judge: {{extra_body: {json.dumps(fields)}}}\n")
    with serving(EchoingServer()) as server:
        command = ["judge-clips", str(tmp_path), "--judge", server.url, "--judge-model", "judge", "--config",
                   str(tmp_path / "my.yaml"), "--judge-key-env", "WM_TEST_KEY", "--reads", str(tmp_path / "reads"),
                   "--audit", str(tmp_path / "audit")]
        assert main(command) == 0
        assert all(body.items() >= fields.items() for body in server.requests)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    reads = [path.read_text() for path in files if path.is_relative_to(tmp_path / "reads")]
    assert any("I was sent [WM_TEST_KEY]" in text for text in reads)
    assert not [path for path in files if re.search(rb"ab.{0,4}cd.{0,4}ef", path.read_bytes())]


def test_a_field_that_the_judge_sets_itself_is_refused_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_clips(tmp_path)
    (tmp_path / "my.yaml").write_text("judge: {extra_body: {response_format: 5, top_k: 3}}\n")
    command = ["judge-clips", str(tmp_path), "--judge", "http://127.0.0.1:9/v1", "--judge-model", "m", "--config"]
    assert main([*command, str(tmp_path / "my.yaml")]) == 2
    assert "judge.extra_body sets response_format, which the judge sets itself; leave it out" in capsys.readouterr().err


def test_the_embedded_judge_abstains_and_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_clips(tmp_path)
    assert main(["judge-clips", str(tmp_path), "--judge", "embedded"]) == 2
    assert "no judge is shipped for task '' (named in clips.jsonl" in capsys.readouterr().err
    assert main(["judge-clips", str(tmp_path), "--judge", JUDGE]) == 1
    out, told = capsys.readouterr()
    assert "error: not one clip has a reward" in told
    assert "2 clips (2 ABSTAIN)" in out and "a: ABSTAIN, planning: 10 frames per second, judged are 5, 2.5" in out
    assert [row["reward"] for row in rows_of(tmp_path)] == [None, None]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"file": "gone.mp4"}, "gone.mp4 is no readable video: No such file"),
        ({"file": "clips.jsonl"}, "clips.jsonl is no readable video"),
        ({"sha256": "0" * 64}, "b.npy has content "),
        ({"reference": "gone.png"}, "gone.png is no readable picture"),
        ({"file": "empty.npy"}, "empty.npy is no readable array"),
        ({"file": "text.npy"}, "text.npy is no readable array"),
        ({"file": "none.npy"}, r"none.npy holds uint8 (0, 96, 96, 3), not frames"),
        ({"file": "row.npy"}, r"row.npy holds float64 (5,), not frames"),
        ({"file": "single.mp4"}, "single.mp4 is no readable video: 1 frames"),
    ],
)
def test_a_clip_that_cannot_be_read_is_named_and_the_others_are_judged_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changed: dict[str, Any], said: str
) -> None:
    lines = write_clips(tmp_path, **{"sha256": "", **changed})
    (tmp_path / "clips.jsonl").write_text("".join(json.dumps(line) + "\n" for line in reversed(lines)))  # it is first
    (tmp_path / "empty.npy").touch()
    (tmp_path / "text.npy").write_bytes(b"\x93NUMPY\x01\x00\x08\x00{'a': 1" + b"\0" * 99)
    np.save(tmp_path / "none.npy", np.zeros((0, 96, 96, 3), np.uint8))
    np.save(tmp_path / "row.npy", np.zeros(5))
    video = cv2.VideoWriter(str(tmp_path / "single.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (96, 96))
    video.write(np.zeros((96, 96, 3), np.uint8))
    video.release()
    with serving(PickyServer()) as server:
        assert main(["judge-clips", str(tmp_path), "--judge", server.url, "--judge-model", "judge"]) == 1
    out = capsys.readouterr().out
    bad, good = rows_of(tmp_path)
    assert (bad["status"], bad["reward"]) == ("ERROR", None) and said in bad["reason"] and said in out
    assert (good["clip_id"], good["status"]) == ("a", "OK") and 0 < good["reward"] <= 1


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"fps": 0}, "clips.jsonl:2: fps: Input should be greater than 0"),
        ({"speed": 2}, "clips.jsonl:2: speed: Extra inputs are not permitted"),
    ],
)
def test_a_line_that_is_none_is_one_error_that_names_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changed: dict[str, Any], said: str
) -> None:
    write_clips(tmp_path, **changed)
    assert main(["judge-clips", str(tmp_path), "--judge", "embedded"]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("separator", ["\u2028", "\u2029", "\u0085"])
def test_a_line_of_the_list_ends_at_a_newline_only_and_a_byte_order_mark_is_left_out(
    tmp_path: Path, separator: str
) -> None:
    words = [f"push{separator}the cube", "pull it"]
    lines = [json.dumps({"file": "a.npy", "instruction": each}, ensure_ascii=False) for each in words]
    for start, end in (("", "\n"), ("\ufeff", "\r\n")):
        (tmp_path / "clips.jsonl").write_bytes((start + end.join([*lines, "", ""])).encode())
        assert [line.instruction for line in read_list(tmp_path)] == words


def test_a_folder_without_a_list_says_what_a_line_is_and_bad_frames_are_an_error_of_their_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["judge-clips", str(tmp_path), "--judge", "embedded"]) == 2
    assert 'one line per clip, e.g. {"file": "a.mp4"' in capsys.readouterr().err
    bad = np.full((17, 96, 96, 3), np.nan, np.float32)
    np.save(tmp_path / "bad.npy", bad)
    line = {"file": "bad.npy", "instruction": "push", "sha256": clip_ref("", bad, 5.0).sha256}
    (tmp_path / "clips.jsonl").write_text(json.dumps(line) + "\n")
    assert main(["judge-clips", str(tmp_path), "--judge", JUDGE]) == 1
    assert "pixels that are not finite" in capsys.readouterr().out
