"""The chained file: what a crash and what a hand can do to it, and that both are seen."""

import errno
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from wm_nodes.judge.audit.log import FILE_NAME, AuditError, AuditLog, Fault, faults, read_lines, recover
from wm_nodes.judge.audit.media import MediaStore


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A log of a header and lines 2 to 5."""
    with AuditLog(tmp_path / "audit") as log:
        for number in range(4):
            log.append("note", {"text": f"number {number}", "value": 0.1 * number})
    return tmp_path / "audit"


def changed(folder: Path, edit: Callable[[list[bytes]], list[bytes]]) -> list[Fault]:
    path = folder / FILE_NAME
    path.write_bytes(b"".join(edit(path.read_bytes().splitlines(keepends=True))))
    return faults(folder)


def test_a_log_is_read_as_it_was_written_and_goes_on_where_it_ended(folder: Path) -> None:
    with AuditLog(folder) as log:
        assert log.append("note", {"text": "later"}) == 6
    lines = list(read_lines(folder))
    assert [line.number for line in lines] == [1, 2, 3, 4, 5, 6]
    assert lines[3].body == {"text": "number 2", "value": 0.2}
    assert lines[-1].hash == log.head
    assert faults(folder) == []
    assert recover(folder).startswith("nothing to recover")


def test_a_changed_word_is_named_by_its_line(folder: Path) -> None:
    (fault,) = changed(folder, lambda lines: [line.replace(b"number 1", b"number 7") for line in lines])
    assert (fault.number, fault.torn) == (3, False)
    assert "a note line: its text was changed" in str(fault)
    with pytest.raises(AuditError, match=r"line 3: a note line.*run `verify`"):
        list(read_lines(folder))
    with pytest.raises(AuditError, match=r"not torn by a crash but changed: line 3"):
        recover(folder)


def test_a_changed_last_line_is_no_crash(folder: Path) -> None:
    (fault,) = changed(folder, lambda lines: [*lines[:-1], lines[-1].replace(b"number 3", b"number 4")])
    assert (fault.number, fault.torn) == (5, False)


def test_a_removed_a_swapped_and_a_forged_line_are_named(folder: Path) -> None:
    whole = (folder / FILE_NAME).read_bytes()
    (gap,) = changed(folder, lambda lines: lines[:2] + lines[3:])
    assert "line 3: a note line: it says it is line 4; lines were removed" in str(gap)
    (folder / FILE_NAME).write_bytes(whole)
    swapped = changed(folder, lambda lines: [lines[0], lines[2], lines[1], *lines[3:]])
    assert [fault.number for fault in swapped] == [2, 3, 4]
    (folder / FILE_NAME).write_bytes(whole)
    with AuditLog(folder.parent / "other") as forger:  # a line with a right hash and a right number of its own
        forger.append("note", {"text": "forged"})
    forged = (folder.parent / "other" / FILE_NAME).read_bytes().splitlines(keepends=True)[1]
    (fault,) = [fault for fault in changed(folder, lambda lines: [lines[0], forged, *lines[2:]]) if fault.number == 3]
    assert "it follows another line than line 2" in str(fault)


def test_a_space_more_is_a_change(folder: Path) -> None:
    (fault,) = changed(folder, lambda lines: [lines[0].replace(b'","', b'", "', 1), *lines[1:]])
    assert fault.number == 1


@pytest.mark.parametrize("number", [b"Infinity", b"[" * 100_000])
def test_a_line_whose_number_cannot_be_read_is_named(folder: Path, number: bytes) -> None:
    (fault,) = changed(folder, lambda lines: [lines[0], lines[1].replace(b'"line":2', b'"line":' + number), *lines[2:]])
    assert (fault.number, fault.torn) == (2, False) and "no line of an audit log" in str(fault)


@pytest.mark.parametrize("cut", [1, 20, 100])
def test_a_torn_last_line_is_told_cut_off_and_kept(folder: Path, cut: int) -> None:
    path = folder / FILE_NAME
    whole = path.read_bytes()
    path.write_bytes(whole[:-cut])
    (fault,) = faults(folder)
    assert (fault.number, fault.torn) == (5, True)
    with pytest.raises(AuditError, match="torn line; run `wm audit recover "):
        AuditLog(folder)
    said = recover(folder)
    assert "of line 5" in said
    assert faults(folder) == []
    lines = list(read_lines(folder))
    assert [line.kind for line in lines] == ["log", "note", "note", "note", "recovered"]
    assert (folder / str(lines[-1].body["file"])).read_bytes() == whole[whole[:-1].rindex(b"\n") + 1 : -cut]
    with AuditLog(folder) as log:
        log.append("note", {})


def test_a_torn_line_in_front_of_whole_ones_is_no_crash(folder: Path) -> None:
    (fault,) = changed(folder, lambda lines: [*lines[:2], lines[2][:30] + b"\n", *lines[3:]])
    assert (fault.number, fault.torn) == (3, False)
    with pytest.raises(AuditError, match="changed"):
        recover(folder)


KILLED = """
import os, sys
from pathlib import Path
from wm_nodes.judge.audit.log import AuditLog
log = AuditLog(Path(sys.argv[1]))
for number in range(100):
    log.append("note", {"number": number})
os._exit(9)
"""


def test_a_process_that_dies_leaves_every_line_it_wrote(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
    assert len(list(read_lines(tmp_path))) == 101


def test_two_writers_at_once_are_refused_with_the_owner_named(folder: Path) -> None:
    with AuditLog(folder):
        code = f"from wm_nodes.judge.audit.log import AuditLog; AuditLog({str(folder)!r})"
        done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
        assert "is being written by process" in done.stderr
        with pytest.raises(AuditError, match=r"is being written by process \d+"):
            recover(folder)
    AuditLog(folder).close()


def test_a_full_disk_leaves_the_log_whole(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with AuditLog(folder) as log:
        file = log._file

        class Full:
            closed = False

            def write(self, data: bytes) -> int:
                if len(data) < 60:
                    raise OSError(28, "No space left on device")
                return file.write(data[: len(data) - 50])

            def fileno(self) -> int:
                return file.fileno()

        monkeypatch.setattr(log, "_file", Full())
        with pytest.raises(OSError, match="free some space"):
            log.append("note", {"text": "half of this"})
        monkeypatch.setattr(log, "_file", file)
        log.append("note", {"text": "after"})
    assert faults(folder) == []
    assert [line.body.get("text") for line in read_lines(folder)][-2:] == ["number 3", "after"]


def test_secrets_are_replaced_before_they_are_written(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JUDGE_API_KEY", "very-secret-value")
    monkeypatch.setenv("MONKEY", "not a secret at all")
    with AuditLog(folder) as log:
        log.append("note", {"reply": ["wrong key very-secret-value", {"head": "Bearer abcdefghijkl"}], "n": 3})
        log.append("note", {"reply": "not a secret at all, a task-oriented risk-free text"})
    text = (folder / FILE_NAME).read_text()
    assert "very-secret-value" not in text
    assert "abcdefghijkl" not in text
    *_, line, clean = read_lines(folder)
    assert line.body["reply"][0] == "wrong key [JUDGE_API_KEY]"
    assert line.body["redacted"] == ["JUDGE_API_KEY", "bearer token or key"]
    assert "redacted" not in clean.body


def test_another_file_is_no_audit_log(tmp_path: Path) -> None:
    with pytest.raises(AuditError, match=r"does not exist; name the folder"):
        faults(tmp_path)
    (tmp_path / FILE_NAME).write_text(json.dumps({"hello": 1}) + "\n")
    with pytest.raises(AuditError, match="ends in a torn line"):
        AuditLog(tmp_path)


def test_pictures_are_stored_once_lossless_and_checked(tmp_path: Path) -> None:
    store, rng = MediaStore(tmp_path), np.random.default_rng(0)
    image = rng.integers(0, 256, (12, 9, 3), np.uint8)
    name = store.put(image)
    assert store.put(image.copy()) == name
    assert len(list((tmp_path / "media").rglob("*.*"))) == 1
    np.testing.assert_array_equal(store.get(name), image)
    floats = np.array([[np.nan, 1.5]], np.float32)
    np.testing.assert_array_equal(store.get(store.put(floats)), floats)
    store.path(name).write_bytes(store.path(name).read_bytes() + b" ")
    with pytest.raises(AuditError, match="was changed after"):
        store.get(name)
    store.path(name).unlink()
    with pytest.raises(AuditError, match="cannot be read"):
        store.get(name)
    with pytest.raises(AuditError, match="no name of a stored picture"):
        store.get("../../etc/passwd.png")


def test_a_full_disk_leaves_no_piece_of_a_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match=r"cannot write .*free some space"):
        MediaStore(tmp_path).put(np.zeros((4, 4, 3), np.uint8))
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
