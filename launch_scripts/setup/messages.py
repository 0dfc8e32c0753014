"""Repair of the wheels' cmake files, build of wm_msgs by colcon, and its links into the virtual environment."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

from setup.console import SetupError, isolated_environment, run, say
from setup.stamp import begin

WHEEL_INCLUDE = re.compile(r"/opt/python/cp3\d+-cp3\d+/include/python3\.\d+")
WHEEL_NUMPY = re.compile(r"/opt/python/cp3\d+-cp3\d+/lib/python3\.\d+/site-packages/numpy/_?core/include")
WHERE = "import numpy, sysconfig; print(sysconfig.get_paths()['include']); print(numpy.get_include())"


def message_sources(msgs: Path) -> list[Path]:
    """Every file that decides what the build produces."""
    interfaces = [path for kind in ("msg", "srv", "action") for path in (msgs / kind).glob(f"*.{kind}")]
    return [msgs / "CMakeLists.txt", msgs / "package.xml", *interfaces]


def repair_cmake(share: Path, include: str, numpy_include: str) -> int:
    """Replace the include folders of the machine on which the wheels were built; return how many files changed."""
    repaired = 0
    for path in sorted(share.rglob("*.cmake")):
        text = path.read_text(errors="surrogateescape")
        new = WHEEL_NUMPY.sub(lambda _: numpy_include, WHEEL_INCLUDE.sub(lambda _: include, text))
        if new != text:
            temporary = path.with_suffix(".tmp")  # not in place: a hard link into uv's cache, and never half a file
            temporary.write_text(new, errors="surrogateescape")
            temporary.replace(path)
            repaired += 1
    return repaired


def build_messages(venv: Path, workspace: Path, log: Path) -> None:
    """Build ros2_ws/src/wm_msgs for the environment's Python. Raises SetupError with the compiler's last lines."""
    python, env = venv / "bin" / "python", isolated_environment(venv)
    answer = subprocess.run([str(python), "-c", WHERE], capture_output=True, text=True, env=env, check=False)
    if answer.returncode:
        begin(venv, "packages")
        raise SetupError(f"numpy is not importable in {venv}:\n{answer.stderr}\n  start again to install it anew")
    include, numpy_include = answer.stdout.split("\n")[:2]
    repair = begin(venv, "messages")
    if repair:
        say("the last build of wm_msgs did not finish: building it from the beginning")
    repair_cmake(venv / "share", include, numpy_include)
    say("building wm_msgs, the message types of this project (1 to 3 minutes)")
    for name in ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"):
        env[name] = str(venv)
    env.pop("COLCON_PREFIX_PATH", None)
    env["MAKEFLAGS"] = f"-j{os.cpu_count() or 1}"
    if repair or not _built_here(workspace, python):
        for folder in (workspace / "build" / "wm_msgs", workspace / "install" / "wm_msgs"):
            if folder.exists():
                shutil.rmtree(folder)
    built = workspace / "install" / "wm_msgs" / "share" / "wm_msgs" / "package.xml"
    built.unlink(missing_ok=True)  # which says to every environment that there is a build
    command = [str(python), "-m", "colcon", "--log-base", "log", "build", "--paths", "src/wm_msgs"]
    cmake = ["-DCMAKE_BUILD_TYPE=Release", "-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={python}"]
    command += ["--event-handlers", "console_direct+", "--cmake-args", *cmake]
    run(command, log=log, why="building wm_msgs", env=env, cwd=workspace)
    link_messages(venv, workspace / "install" / "wm_msgs")


def link_messages(venv: Path, install: Path) -> None:
    """Make wm_msgs part of the virtual environment, to be imported without sourcing: the wheels' loader looks for
    libraries in <venv>/lib and for packages in <venv>/share; a .pth file names the Python modules."""
    for library in sorted((install / "lib").glob("lib*.so")):
        _link(venv / "lib" / library.name, library)
    _link(venv / "share" / "wm_msgs", install / "share" / "wm_msgs")
    for marker in sorted((install / "share" / "ament_index" / "resource_index").glob("*/wm_msgs")):
        _link(venv / "share" / "ament_index" / "resource_index" / marker.parent.name / "wm_msgs", marker)
    modules = next((install / "lib").glob("python3.*/site-packages"), None)
    if modules is None:
        raise SetupError(f"{install} holds no Python modules; delete it and start again")
    site = next((venv / "lib").glob("python3.*/site-packages"))
    (site / "wm_workspace.pth").write_text(f"{modules}\n")


def _built_here(workspace: Path, python: Path) -> bool:
    """True where an earlier build of this checkout, with this Python, can be continued."""
    try:
        cache = (workspace / "build" / "wm_msgs" / "CMakeCache.txt").read_text(errors="replace")
    except OSError:
        return False
    return f"{workspace}/build/wm_msgs" in cache and str(python) in cache


def _link(link: Path, target: Path) -> None:
    link.parent.mkdir(parents=True, exist_ok=True)
    link.unlink(missing_ok=True)
    link.symlink_to(target)
