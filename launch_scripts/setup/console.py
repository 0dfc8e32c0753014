"""What the set-up says and how it runs commands."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

BOOTSTRAPPED = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
DROPPED = {"PYTHONHOME", BOOTSTRAPPED, "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "COLCON_PREFIX_PATH"}


class SetupError(RuntimeError):
    """The set-up cannot continue; the text says why and what to do."""


def say(text: str) -> None:
    print(f"[set-up] {text}", file=sys.stderr, flush=True)


def output_of(command: list[str], env: dict[str, str] | None = None) -> str:
    """What a command prints; nothing where it does not exist, fails, or takes more than 30 s."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=env, timeout=30, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return "" if done.returncode else done.stdout


def run(command: list[str], *, log: Path, why: str, env: dict[str, str] | None = None, cwd: Path | None = None) -> None:
    """Run a command; append its output to `log`. Raises SetupError with its last lines and the log file."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as sink:
        sink.write(f"\n$ {' '.join(command)}\n".encode())
        sink.flush()
        start = sink.tell()
        try:
            code = subprocess.call(command, stdout=sink, stderr=subprocess.STDOUT, env=env, cwd=cwd)
        except FileNotFoundError as error:
            raise SetupError(f"{why}: {error.filename} is not installed") from None
    if code:
        output = log.read_bytes()[start:].decode(errors="replace").strip().splitlines()
        tail = "\n".join(f"    {line}" for line in output[-15:])
        raise SetupError(f"{why} failed (exit code {code}): {' '.join(command)}\n{tail}\n  full log: {log}")


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
