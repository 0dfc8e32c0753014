"""What the set-up says and how it runs commands."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

BOOTSTRAPPED = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
DROPPED = {"PYTHONHOME", BOOTSTRAPPED, "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "COLCON_PREFIX_PATH"}

PATIENCE_S = 5.0
"""How long an interrupted command may take to end by itself."""


class SetupError(RuntimeError):
    """The set-up cannot continue; the text says why and what to do."""


def say(text: str) -> None:
    print(f"[set-up] {text}", file=sys.stderr, flush=True)


def output_of(command: list[str], env: dict[str, str] | None = None) -> str:
    """What a command prints; nothing where it does not exist, fails, or takes more than 30 s."""
    try:
        done = subprocess.run(
            command, capture_output=True, encoding="utf-8", errors="replace", env=env, timeout=30, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return "" if done.returncode else done.stdout


def run(
    command: list[str], *, log: Path, why: str, env: dict[str, str] | None = None, cwd: Path | None = None,
    asks: bool = False,
) -> None:
    """Run a command; append its output to `log`. Raises SetupError with its last lines and the log file.

    At Ctrl-C, the command and all that it started end before KeyboardInterrupt goes on. They inherit the set-up's lock:
    where only this process is killed, the next start waits for them.

    Args:
        asks: it may ask for a password at the terminal (sudo), and Ctrl-C waits for its end instead of enforcing it.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as sink:
        sink.write(f"\n$ {' '.join(command)}\n".encode())
        sink.flush()
        start = sink.tell()
        try:
            child = subprocess.Popen(
                command, stdin=None if asks else subprocess.DEVNULL, stdout=sink, stderr=subprocess.STDOUT, env=env,
                cwd=cwd, start_new_session=not asks, close_fds=False,
            )
        except FileNotFoundError as error:
            raise SetupError(f"{why}: {error.filename} is not installed") from None
        try:
            code = child.wait()
        except KeyboardInterrupt:
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_IGN)  # a second Ctrl-C would leave them behind
            if asks:
                say("waiting for the package manager to end")
                child.wait()
            else:
                _end_group(child)
            raise
    if code:
        output = log.read_bytes()[start:].decode(errors="replace").strip().splitlines()
        tail = "\n".join(f"    {line}" for line in output[-15:])
        free = shutil.disk_usage(log.parent).free // 2**20
        full = f"\n  only {free} MB are free in {log.parent}: make room, then start again" if free < 100 else ""
        raise SetupError(f"{why} failed (exit code {code}): {' '.join(command)}\n{tail}\n  full log: {log}{full}")


def _end_group(child: subprocess.Popen[bytes]) -> None:
    """End a command that has its own session, politely at first, and return when none of its processes is left."""
    for number in (signal.SIGINT, signal.SIGKILL):
        patience = time.monotonic() + PATIENCE_S
        with suppress(ProcessLookupError):
            os.killpg(child.pid, number)
        while time.monotonic() < patience:
            if not _group_lives(child.pid):
                child.wait()
                return
            time.sleep(0.05)


def _group_lives(group: int) -> bool:
    """True where a process of a group has not ended; one that nobody has waited for has."""
    for file in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _, its = file.read_text(encoding="utf-8").rpartition(")")[2].split()[:3]
            if int(its) == group and state != "Z":
                return True
    return False


def isolated_environment(venv: Path) -> dict[str, str]:
    """Return the environment in which the virtual environment's programs run, free of any other ROS or Python set-up.

    Left out, because two sets of ROS libraries in one process crash: a sourced ROS 2 under /opt/ros, another virtual
    environment or colcon workspace, and the variable by which the wheels mark that libraries have been found.
    """
    env = {k: v for k, v in os.environ.items() if k not in DROPPED}
    for name in ("PYTHONPATH", "LD_LIBRARY_PATH"):
        kept = [part for part in env.pop(name, "").split(os.pathsep) if part and not _foreign(Path(part), venv)]
        if kept:
            env[name] = os.pathsep.join(kept)
    path = [part for part in env.get("PATH", os.defpath).split(os.pathsep) if part and not _foreign(Path(part), venv)]
    scripts = str(venv / "bin")
    env["PATH"] = os.pathsep.join([scripts, *(part for part in path if part != scripts)])
    env["VIRTUAL_ENV"] = str(venv)
    return env


def _foreign(part: Path, venv: Path) -> bool:
    if part.parts[:3] == ("/", "opt", "ros"):
        return True
    folders = (part, *part.parents)
    if any((folder / ".colcon_install_layout").exists() for folder in folders):
        return venv.parent not in folders
    return any((folder / "pyvenv.cfg").exists() and folder != venv for folder in folders)
