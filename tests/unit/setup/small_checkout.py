"""A checkout whose set-up takes seconds: the real launch_scripts/setup over small wheels, messages and wm_nodes.

venv, pip, uv, colcon, cmake and the compiler are real; colcon and uv run from the environment of the tests. Only system
packages are left out.
"""

import fcntl
import importlib.metadata
import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
import zipfile
from contextlib import suppress
from pathlib import Path

from setup.packages import UV

SETUPTOOLS = importlib.metadata.distribution("setuptools")
NO_SYSTEM_PACKAGES = "def current_plan(): ...\ndef install(plan, log): return True\n"
WHEEL_CMAKE = 'set(dirs "/opt/python/cp312-cp312/include/python3.12")\n'
COLCON = """
import sys
sys.path.append({site!r})
from colcon_core.command import main
raise SystemExit(main())
"""
CMAKE = """
cmake_minimum_required(VERSION 3.16)
project({name} C)
add_library({name} SHARED one.c two.c three.c)
install(TARGETS {name} DESTINATION lib)
install(FILES package.xml DESTINATION share/{name})
install(FILES package.xml DESTINATION share/ament_index/resource_index/packages RENAME {name})
install(FILES msg/__init__.py DESTINATION lib/python{python}/site-packages/{name}/msg)
"""
PACKAGE_XML = """<package format="3"><name>{name}</name><version>1.0.0</version><description>-</description>
<maintainer email="a@b.c">-</maintainer><license>-</license><export><build_type>cmake</build_type></export></package>
"""
NODES = "from setuptools import setup\nsetup(name='wm_nodes', version='1.0', packages=['wm_nodes'])\n"


class SmallCheckout:
    """The folder, its environment, and how its set-up is started and interrupted."""

    def __init__(self, folder: Path, repository: Path, *, root: str = "checkout", venv: str = "own") -> None:
        self.root = folder / root
        self.venv, self.log = folder / venv, folder / f"{venv}_setup.log"
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(repository / "launch_scripts" / "setup", self.root / "launch_scripts" / "setup", ignore=ignored)
        for name, text in {
            "launch_scripts/setup/system.py": NO_SYSTEM_PACKAGES,
            "requirements/lock.txt": f"setuptools=={SETUPTOOLS.version}\nparts\n",
            "requirements/torch-cpu.txt": "torch\n", "requirements/torch-gpu.txt": "torch\n",
            **_message_package("msgs_schema", "wm_msgs"), **_message_package("msgs_schema/tf2_msgs", "tf2_msgs"),
            "wm_nodes/setup.py": NODES, "wm_nodes/setup.cfg": "",
            "wm_nodes/wm_nodes/__init__.py": "__version__ = '1'\n",
            "wm_nodes/pyproject.toml": "[build-system]\nrequires = ['setuptools']\n",
        }.items():
            (self.root / name).parent.mkdir(parents=True, exist_ok=True)
            (self.root / name).write_text(text, encoding="utf-8")
        (self.root / "ros2_ws" / "src").mkdir(parents=True)
        (self.root / "ros2_ws" / "src" / "wm_msgs").symlink_to("../../msgs_schema")
        wheels = folder / "wheels"
        wheels.mkdir()
        self._write_wheels(wheels)
        dropped = ("PYTHONPATH", "AMENT_PREFIX_PATH", "VIRTUAL_ENV", "PIP_", "UV_")
        self.environment = {name: value for name, value in os.environ.items() if not name.startswith(dropped)}
        self.environment |= {
            "WM_VENV": str(self.venv), "UV_CACHE_DIR": str(folder / "cache"), "UV_OFFLINE": "1", "UV_NO_CONFIG": "1",
            "PIP_CONFIG_FILE": os.devnull, "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(wheels), "PIP_NO_CACHE_DIR": "1",
        }

    def go_to(self, root: Path) -> None:
        """The checkout, with its environment inside, has been moved or copied to `root`."""
        self.venv = root / self.venv.relative_to(self.root)
        self.log, self.root = self.venv.with_name(self.log.name), root
        self.environment["WM_VENV"] = str(self.venv)

    def _write_wheels(self, folder: Path) -> None:
        site, uv = sysconfig.get_paths()["purelib"], Path(sysconfig.get_paths()["scripts"]) / "uv"
        program = f'#!/bin/sh\nexec {uv} "$@"\n'
        _write_wheel(folder, "uv", UV.partition("==")[2], {"uv/__init__.py": "", "uv.data/scripts/uv": program})
        _write_wheel(folder, "torch", "2.13.0", {"torch/__init__.py": "__version__ = '2.13.0'\n"})
        _write_wheel(folder, "parts", "1.0", {
            "rclpy/__init__.py": "", "numpy/__init__.py": "def get_include(): return '/numpy'\n",
            "colcon/__main__.py": COLCON.format(site=site), "parts.data/data/share/parts/export.cmake": WHEEL_CMAKE,
        })
        kept = [file for file in SETUPTOOLS.files or () if file.suffix in {".py", ".txt"}]
        files = {str(file): file.locate().read_bytes() for file in kept}
        _write_wheel(folder, "setuptools", SETUPTOOLS.version, files)

    def start(self, *, limit: int | None = None) -> subprocess.Popen[str]:
        """Start the set-up in a session of its own; no process of it may write a file longer than `limit` bytes."""
        command = [sys.executable, str(self.root / "launch_scripts" / "setup")]
        limited = ["prlimit", f"--fsize={limit}", *command] if limit else command
        return subprocess.Popen(
            limited, env=self.environment, cwd=self.root, encoding="utf-8", start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # ignored in background jobs
        )

    def complete(self) -> str:
        """Set up without interruption; return what the set-up says. It ends by importing four packages."""
        child = self.start()
        out, err = child.communicate()
        assert child.returncode == 0 and "wm_nodes 1 on Python" in out, (out, err, self.log.read_text("utf-8")[-3000:])
        assert f"{self.venv}/lib" in out and f"{self.root}/ros2_ws/install" in out
        assert self.tf2_msgs().is_file()
        return err

    def tf2_msgs(self) -> Path:
        """The module from which the environment imports TFMessage."""
        command = [self.venv / "bin" / "python", "-c", "import tf2_msgs.msg as m; print(m.TFMessage and m.__file__)"]
        done = subprocess.run(command, cwd=self.venv, env=self.environment, capture_output=True, check=True)
        return Path(os.fsdecode(done.stdout).strip())

    def interrupt(self, word: str, delay_s: float, how: str) -> tuple[int, str]:
        """Start; `delay_s` after a command with `word` in it has begun, interrupt; return (exit code, what was said).

        Args:
            how: a signal's name, for the first process alone, or "KILL ALL" for each.
        """
        before = self.log.stat().st_size if self.log.exists() else 0
        child = self.start()
        while child.poll() is None and not self._runs(word, before):
            time.sleep(0.005)
        time.sleep(delay_s)
        if how != "KILL ALL":
            child.send_signal(signal.Signals[f"SIG{how}"])
        while how == "KILL ALL" and (processes := self.processes()):
            for pid in processes:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        _, err = child.communicate()
        return child.returncode, err

    def _runs(self, word: str, before: int) -> bool:
        text = self.log.read_bytes()[before:].decode(errors="replace") if self.log.exists() else ""
        return any(line.startswith("$ ") and word in line for line in text.splitlines())

    def processes(self) -> list[int]:
        """Every living process that the set-up started, found by its environment."""
        return [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit() and self._started(path)]

    def _started(self, process: Path) -> bool:
        try:
            return f"WM_VENV={self.venv}\0".encode() in (process / "environ").read_bytes()
        except OSError:
            return False

    def locked(self) -> bool:
        with self.venv.with_name(self.venv.name + ".lock").open("w", encoding="utf-8") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
        return False


def _message_package(folder: str, name: str) -> dict[str, str]:
    python = f"{sys.version_info[0]}.{sys.version_info[1]}"
    files = {"CMakeLists.txt": CMAKE.format(name=name, python=python), "package.xml": PACKAGE_XML.format(name=name)}
    files |= {"msg/__init__.py": "TFMessage = ...\n", **{f"{c}.c": f"int {c};\n" for c in ("one", "two", "three")}}
    return {f"{folder}/{file}": text for file, text in files.items()}


def _write_wheel(folder: Path, name: str, version: str, files: dict[str, str | bytes]) -> None:
    """Write a wheel; `name.data/` stands for its folder of scripts and data."""
    info = f"{name}-{version}.dist-info"
    entries = {path.replace(f"{name}.data/", f"{name}-{version}.data/", 1): content for path, content in files.items()}
    entries[f"{info}/METADATA"] = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    entries[f"{info}/WHEEL"] = "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    with zipfile.ZipFile(folder / f"{name}-{version}-py3-none-any.whl", "w") as wheel:
        for path, content in entries.items():
            entry = zipfile.ZipInfo(path)
            entry.external_attr = (0o100755 if "/scripts/" in path else 0o100644) << 16
            wheel.writestr(entry, content)
        wheel.writestr(f"{info}/RECORD", "".join(f"{path},,\n" for path in [*entries, f"{info}/RECORD"]))
