"""A run folder has one writer: real processes take it, lose it, and are told who holds it."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from run_holders import HOLD, holder, start_holder

from wm_nodes.training.run_lock import NAME, Holder, RunFolderInUseError, RunLock

RACERS, RACES = 4, 5


def held_by(folder: Path) -> Holder:
    return Holder(**json.loads((folder / NAME).read_text()))


def write(folder: Path, **values: Any) -> None:
    """The lock file of this process with other values."""
    with RunLock(folder):
        text = json.dumps(asdict(replace(held_by(folder), **values)))
        folder.mkdir(exist_ok=True)
    folder.mkdir(exist_ok=True)
    (folder / NAME).write_text(text)


def refusal(folder: Path) -> str:
    with pytest.raises(RunFolderInUseError) as caught:
        RunLock(folder).acquire()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_file_says_host_process_and_start_and_a_second_process_is_told(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with holder(folder) as process:
        found = held_by(folder)
        assert (found.host, found.process) == (os.uname().nodename, process.pid)
        assert time.strftime("%Y-%m-%d") in found.since and found.command.startswith("-c ")
        text = refusal(folder)
        assert f"{folder} is in use by process {process.pid} on {found.host} since {found.since}" in text
        assert text.endswith("; stop it, or give another run_dir")
    with RunLock(folder):
        assert held_by(folder).process == os.getpid()


@pytest.mark.slow
@pytest.mark.parametrize("stale", [False, True])
def test_of_processes_that_start_at_once_exactly_one_gets_the_folder(stale: bool, tmp_path: Path) -> None:
    for race in range(RACES):
        folder, gate = tmp_path / f"run{race}", tmp_path / f"gate{race}"
        folder.mkdir()
        if stale:
            write(folder, process=2**22 + 1)
        racers = [start_holder(folder, gate) for _ in range(RACERS)]
        time.sleep(1.0)  # until all wait at the gate
        gate.touch()
        said = [racer.stdout.readline() for racer in racers if racer.stdout is not None]
        winners = [racer.pid for racer, line in zip(racers, said, strict=True) if line == "held\n"]
        assert len(winners) == 1, said
        assert sum(f"in use by process {winners[0]} " in line for line in said) == RACERS - 1, said
        for racer in racers:
            racer.communicate()
        assert not (folder / NAME).exists()


def test_a_killed_holder_is_taken_over_and_one_line_says_so(tmp_path: Path) -> None:
    said = list[str]()
    process = start_holder(tmp_path)
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    process.kill()
    while os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT) is None:  # dead, and nobody has looked yet
        time.sleep(0.01)
    with RunLock(tmp_path, say=said.append):
        assert held_by(tmp_path).process == os.getpid()
    process.communicate()
    (line,) = said
    assert f"taking over the lock of process {process.pid} on" in line and line.endswith("which is gone")


def test_a_process_number_that_was_used_again_holds_nothing(tmp_path: Path) -> None:
    with subprocess.Popen(["sleep", "60"]) as other:
        said = list[str]()
        write(tmp_path, process=other.pid, started=1)
        with RunLock(tmp_path, say=said.append):
            assert len(said) == 1 and f"process {other.pid} " in said[0]
        write(tmp_path, process=other.pid, started=started(other.pid))
        assert f"in use by process {other.pid}" in refusal(tmp_path)
        other.kill()


def started(process: int) -> int:
    return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[19])


@pytest.mark.parametrize("elsewhere", [{"host": "robot7"}, {"pid_namespace": "pid:[1]"}])
def test_a_holder_that_cannot_be_checked_is_believed(elsewhere: dict[str, str], tmp_path: Path) -> None:
    write(tmp_path, process=2**22 + 1, **elsewhere)
    text = refusal(tmp_path)
    assert f"process {2**22 + 1} on {elsewhere.get('host', os.uname().nodename)} since" in text
    assert f"stop it there, or delete {tmp_path / NAME} if that host or container is gone" in text
    (tmp_path / NAME).unlink()
    with RunLock(tmp_path):
        pass


@pytest.mark.parametrize("text", ["{", "[]", "{}", "\x00\x00"])
def test_a_torn_lock_file_is_taken_over(text: str, tmp_path: Path) -> None:
    (tmp_path / NAME).write_text(text)
    said = list[str]()
    with RunLock(tmp_path, say=said.append):
        assert said == [f"run folder {tmp_path}: taking over the lock file, which cannot be read"]


def test_ctrl_c_lets_go_of_the_folder(tmp_path: Path) -> None:
    with holder(tmp_path) as process:
        process.send_signal(signal.SIGINT)
        assert process.stdout is not None and process.stdout.readline() == "interrupted\n"
        process.wait()
        assert not (tmp_path / NAME).exists()


def test_the_end_of_a_process_lets_go_of_its_folder(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from wm_nodes.training.run_lock import RunLock\n"
        "RunLock(Path(sys.argv[1])).acquire(); raise KeyboardInterrupt"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, check=False)
    assert done.returncode == -signal.SIGINT and not (tmp_path / NAME).exists()


def test_what_a_holder_starts_is_its_own_and_lets_nobody_else_in(tmp_path: Path) -> None:
    with RunLock(tmp_path):
        child = [sys.executable, "-c", HOLD, str(tmp_path)]
        grandchild = ["sh", "-c", '"$@"; true', "sh", *child]
        for command in (child, grandchild):
            done = subprocess.run(command, input="", capture_output=True, text=True, check=True)
            assert done.stdout == "held\n" and not done.stderr
            assert held_by(tmp_path).process == os.getpid()
        with RunLock(tmp_path):
            pass
        assert held_by(tmp_path).process == os.getpid()
    assert not (tmp_path / NAME).exists()


def test_a_folder_that_only_the_lock_has_made_goes_with_it(tmp_path: Path) -> None:
    made, used = tmp_path / "made", tmp_path / "used"
    with RunLock(made), RunLock(used):
        (used / "config.yaml").touch()
    assert not made.exists() and [path.name for path in used.iterdir()] == ["config.yaml"]


def test_a_folder_in_which_nothing_may_be_written_is_named_as_such(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.open

    def opened(path: Any, flags: int, mode: int = 0o777) -> int:
        if flags & os.O_CREAT:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return real(path, flags, mode)

    monkeypatch.setattr(os, "open", opened)
    with pytest.raises(PermissionError, match=f"Permission denied: '{tmp_path / NAME}'"):
        RunLock(tmp_path).acquire()


def test_a_lock_file_that_a_person_deleted_is_no_trouble(tmp_path: Path) -> None:
    with RunLock(tmp_path):
        (tmp_path / NAME).unlink()
        with holder(tmp_path) as other:
            assert held_by(tmp_path).process == other.pid
    lock = RunLock(tmp_path)
    lock.acquire()
    with_other = replace(held_by(tmp_path), process=1, started=1)
    (tmp_path / NAME).write_text(json.dumps(asdict(with_other)))
    lock.release()
    assert held_by(tmp_path) == with_other


def test_new_folders_of_one_name_are_as_many_as_processes_begin_them_at_once(tmp_path: Path) -> None:
    wanted, names = tmp_path / "runs" / "20260101-000000-push", ["", "-2", "-3", "-4"]
    code = f"""
import sys; from pathlib import Path; from wm_nodes.training.run_lock import RunLock
with RunLock(Path({str(wanted)!r}), new=True) as lock:
    print(lock.folder, flush=True)
    (lock.folder / "config.yaml").touch()
    sys.stdin.read()
"""
    pipe = subprocess.PIPE
    racers = [subprocess.Popen([sys.executable, "-c", code], stdin=pipe, stdout=pipe) for _ in range(RACERS)]
    folders = sorted(Path(os.fsdecode(racer.stdout.readline()).strip()) for racer in racers if racer.stdout)
    assert folders == [Path(f"{wanted}{name}") for name in names[:RACERS]]
    assert all(refusal(folder) for folder in folders)
    for racer in racers:
        racer.communicate()
        assert racer.returncode == 0
    with RunLock(wanted, new=True) as lock:
        assert lock.folder == Path(f"{wanted}-{RACERS + 1}")
    assert not lock.folder.exists(), "nobody wrote into it"
