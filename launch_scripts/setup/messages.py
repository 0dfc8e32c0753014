"""Repair of the wheels' cmake files, build of the message packages by colcon, and their links into the environment."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

from setup.console import SetupError, isolated_environment, output_of, run, say
from setup.stamp import begin

WHEEL_INCLUDE = re.compile(r"/opt/python/cp3\d+-cp3\d+/include/python3\.\d+")
WHEEL_NUMPY = re.compile(r"/opt/python/cp3\d+-cp3\d+/lib/python3\.\d+/site-packages/numpy/_?core/include")
WHERE = "import numpy, sysconfig; print(sysconfig.get_paths()['include']); print(numpy.get_include())"
TF = "tf2_msgs"
"""The frames of ROS 2's tools, which the wheels lack. Its folder in the environment keeps its build out of the
workspace, where it would hide ROS 2's own from those who source that."""
FIND_TF = f"from {TF}.msg import TFMessage; print(TFMessage)"


IDL_FILES = 'file(STRINGS "${idl_output}" idl_tuples'
"""CMake reads paths with an umlaut only where it is told the encoding."""


def message_sources(msgs: Path) -> list[Path]:
    """Every file that decides what the build produces."""
    kinds, packages = ("msg", "srv", "action"), (msgs, msgs / TF)
    interfaces = [path for package in packages for kind in kinds for path in (package / kind).glob(f"*.{kind}")]
    return [package / name for package in packages for name in ("CMakeLists.txt", "package.xml")] + interfaces


def lacks_tf(venv: Path) -> bool:
    """True where tf2_msgs was built for the environment and is not there any more."""
    link = venv / "share" / TF
    return link.is_symlink() and not link.exists()


def repair_cmake(share: Path, include: str, numpy_include: str) -> int:
    """Replace the include folders of the machine on which the wheels were built; return how many files changed."""
    repaired = 0
    for path in sorted(share.rglob("*.cmake")):
        text = os.fsdecode(path.read_bytes())
        new = WHEEL_NUMPY.sub(lambda _: numpy_include, WHEEL_INCLUDE.sub(lambda _: include, text))
        new = new.replace(f"{IDL_FILES})", f"{IDL_FILES} ENCODING UTF-8)")
        if new != text:
            replace_file(path, os.fsencode(new))
            repaired += 1
    return repaired


def replace_file(path: Path, data: bytes) -> None:
    """Write a file anew: not in place, as it may be a hard link into uv's cache, and never half of it."""
    temporary = path.with_suffix(".tmp")
    temporary.write_bytes(data)
    shutil.copymode(path, temporary)
    temporary.replace(path)


def build_messages(venv: Path, workspace: Path, log: Path, *, built: bool = False) -> None:
    """Build ros2_ws/src/wm_msgs for the environment's Python, unless it is built, and tf2_msgs where that finds none.

    Raises SetupError with the compiler's last lines.
    """
    python, env = venv / "bin" / "python", isolated_environment(venv)
    answer = subprocess.run(
        [str(python), "-c", WHERE], capture_output=True, encoding="utf-8", errors="replace", env=env, check=False
    )
    if answer.returncode:
        begin(venv, "packages")
        raise SetupError(f"numpy is not importable in {venv}:\n{answer.stderr}\n  start again to install it anew")
    include, numpy_include = answer.stdout.split("\n")[:2]
    repair = begin(venv, "messages")
    if repair:
        say("the last build of wm_msgs did not finish: building it from the beginning")
    repair_cmake(venv / "share", include, numpy_include)
    bases = {} if built else {"wm_msgs": workspace}
    if lacks_tf(venv):
        (venv / "share" / TF).unlink()
    if (venv / TF).exists() or not output_of([str(python), "-c", FIND_TF], env):
        bases[TF] = venv / TF
    about = {"wm_msgs": "wm_msgs, the message types of this project", TF: f"{TF} for the frames of cameras"}
    if bases:
        say(f"building {', and '.join(about[name] for name in bases)} (1 to 3 minutes)")
    for name in ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"):
        env[name] = str(venv)
    env.pop("COLCON_PREFIX_PATH", None)
    env["PYTHONUTF8"] = "1"  # the generators read and write as the locale says
    env["MAKEFLAGS"] = f"-j{os.cpu_count() or 1}"
    cmake = ["-DCMAKE_BUILD_TYPE=Release", "-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={python}"]
    for name, base in bases.items():
        source = workspace / "src" / "wm_msgs" / ("" if name == "wm_msgs" else name)
        build, install = base / "build" / name, base / "install" / name
        if repair or not _built_here(source, build, python):
            for folder in (build, install):
                if folder.exists():
                    shutil.rmtree(folder)
        built = install / "share" / name / "package.xml"
        built.unlink(missing_ok=True)  # which says to every environment that there is a build
        command = [str(python), "-m", "colcon", "--log-base", str(base / "log"), "build", "--paths", str(source)]
        command += ["--build-base", str(build.parent), "--install-base", str(install.parent)]
        command += ["--event-handlers", "console_direct+", "--cmake-args", *cmake]
        run(command, log=log, why=f"building {name}", env=env, cwd=workspace)
    installs = {workspace / "install" / "wm_msgs", *(base / "install" / name for name, base in bases.items())}
    link_messages(venv, workspace.parent, sorted(installs))


def link_messages(venv: Path, root: Path, installs: list[Path]) -> None:
    """Make packages part of the virtual environment, to be imported without sourcing: the wheels' loader looks for
    libraries in <venv>/lib and for packages in <venv>/share; a .pth file names the Python modules."""
    site, found = next((venv / "lib").glob("python3.*/site-packages")), []
    for install in installs:
        links = {venv / "lib" / library.name: library for library in sorted((install / "lib").glob("lib*.so"))}
        links[venv / "share" / install.name] = install / "share" / install.name
        index = Path("share", "ament_index", "resource_index")
        for marker in sorted((install / index).glob(f"*/{install.name}")):
            links[venv / index / marker.parent.name / install.name] = marker
        for link, target in links.items():
            link.parent.mkdir(parents=True, exist_ok=True)
            link.unlink(missing_ok=True)
            link.symlink_to(written_in(link.parent, target, root))
        modules = next((install / "lib").glob("python3.*/site-packages"), None)
        if modules is None:
            raise SetupError(f"{install} holds no Python modules; delete it and start again")
        found.append(f"{written_in(site, modules, root)}\n")
    (site / "wm_workspace.pth").write_bytes(os.fsencode("".join(found)))  # Python reads it as it does file names


def written_in(folder: Path, target: Path, root: Path) -> str:
    """How a link or .pth file in `folder` names `target`: without the checkout's own folder where both are in it."""
    return os.path.relpath(target, folder) if root in folder.parents and root in target.parents else str(target)


def _built_here(source: Path, build: Path, python: Path) -> bool:
    """True where an earlier build of these sources in this folder, with this Python, can be continued."""
    try:
        cache = (build / "CMakeCache.txt").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    return all(part in cache for part in (f"={source}\n", f"={build}\n", str(python)))
