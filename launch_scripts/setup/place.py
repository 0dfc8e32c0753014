"""Where an environment and its builds lie: after a move or a copy of the checkout all that names the old folder is
written anew, in seconds, without a compiler or a download, so that nothing of the old folder is used."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from setup.console import SetupError, isolated_environment, run
from setup.messages import TF, link_messages, replace_file, written_in
from setup.stamp import BEGUN, read_stamp, stamp_file

ROOT, VENV = "checkout", "environment"
"""Names of the two folders in the stamp."""
MAX_BYTES = 2**20
"""Of files that name folders; larger ones are programs."""
FIRST_LINE = re.compile(rb"\A#!(?:/bin/sh\n'''exec' .*\n' '''|.*)\n")
"""Of a script that pip or uv installed; its second form is theirs for long paths and those with a space."""
MOVABLE = b"""#!/bin/sh
'''exec' "$(dirname -- "$(realpath -- "$0")")/python" "$0" "$@"
' '''
"""
"""Starts the Python beside the script, wherever that is."""


def former(venv: Path, root: Path) -> dict[str, str]:
    """Where the checkout and the environment were at the end of the last set-up; {} where there is no environment."""
    stamp, activate = read_stamp(stamp_file(venv)), venv / "bin" / "activate"
    if stamp.get("venv") == BEGUN or not activate.exists():
        return {}
    if ROOT in stamp and VENV in stamp:
        return {name: stamp[name] for name in (ROOT, VENV)}
    named = re.search(r"^VIRTUAL_ENV=[\"']?(.*?)[\"']?$", activate.read_text(encoding="utf-8"), re.M)
    old = Path(named[1] if named else venv)  # of a set-up that did not note it
    return {VENV: str(old), ROOT: str(old.parent if venv.parent == root else root)}


def present(venv: Path, root: Path) -> dict[str, str]:
    """The same of now."""
    return {ROOT: str(root), VENV: str(venv)}


def refuse_links(root: Path, folders: Iterable[Path]) -> None:
    """Raise SetupError where a folder is a link that leads nowhere, or into another checkout than `root`: what is
    written there is no longer the other's."""
    for folder in folders:
        if folder.is_symlink() and not folder.exists():
            raise SetupError(f"{folder} is a link that leads nowhere; remove it")
        homes = [parent for parent in folder.resolve().parents if (parent / "launch_scripts" / "setup").is_dir()]
        if folder.is_symlink() and homes and homes[0] != root.resolve():
            raise SetupError(
                f"{folder} is a link into another checkout, whose environment the set-up would make that of this one; "
                f"remove the link, or work in {homes[0]}"
            )


def settle(venv: Path, root: Path, log: Path, before: Mapping[str, str] | None = None) -> None:
    """Let the environment, and the messages that were built for it, name the folders in which they are.

    Args:
        before: what former() says, after a move.
    """
    workspace, site = root / "ros2_ws", next((venv / "lib").glob("python3.*/site-packages"))
    installs = [workspace / "install" / "wm_msgs", venv / TF / "install" / TF]
    now = present(venv, root)
    pairs = [(Path(old), Path(now[name])) for name, old in {**now, **(before or {})}.items()]
    moved = any(old != new for old, new in pairs)
    names = {os.fsencode(name): os.fsencode(new_name) for old, new in [*pairs, (root, root), (venv, venv)]
             for name, new_name in ((str(old), str(new)), (old.as_uri(), new.as_uri()))}
    if moved:
        for build in (workspace / "build" / "wm_msgs", venv / TF / "build" / TF):
            shutil.rmtree(build, ignore_errors=True)  # CMake goes on only where it began
    longest_first = b"|".join(re.escape(name) for name in sorted(names, key=len, reverse=True))
    pattern = re.compile(b"(?:" + longest_first + rb")(?![\w.\x80-\xff-])")
    folders = [venv / "share", *(install.parent for install in installs)] if moved else []
    for file in _files(venv / "bin", site, folders):
        data = file.read_bytes()
        if b"\0" in data:
            continue
        new = pattern.sub(lambda found: names[found[0]], data) if moved else data
        first = FIRST_LINE.match(new)
        if first and os.fsencode(venv / "bin" / "python") in first[0]:
            new = MOVABLE + new[first.end():]
        if new != data:
            replace_file(file, new)
    whole = [install for install in installs if (install / "share" / install.name / "package.xml").exists()]
    link_messages(venv, root, whole)
    for file in site.glob("__editable__.wm_nodes-*.pth"):
        replace_file(file, os.fsencode(f"{written_in(site, root / 'wm_nodes', root)}\n"))
    if moved:
        _rewrite_activation(venv, log)  # the last, as former() may read it


def _files(scripts: Path, site: Path, folders: Iterable[Path]) -> Iterator[Path]:
    """Every file that may name a folder."""
    found = [*scripts.iterdir(), *site.glob("wm_nodes-*.dist-info/direct_url.json")]
    for folder in folders:
        found += folder.rglob("*.cmake" if folder.name == "share" else "*")
    return (file for file in found if not file.is_symlink() and file.is_file() and file.stat().st_size <= MAX_BYTES)


def _rewrite_activation(venv: Path, log: Path) -> None:
    """Make pyvenv.cfg and the scripts to activate the environment anew, each with the quotes that its shell needs."""
    config = (venv / "pyvenv.cfg").read_text(encoding="utf-8")
    shared = ["--system-site-packages"] if re.search(r"include-system-site-packages\s*=\s*true", config) else []
    command = [str(venv / "bin" / "python"), "-m", "venv", "--without-pip", *shared, str(venv)]
    run(command, log=log, why="writing the environment's new folder into it", env=isolated_environment(venv))
