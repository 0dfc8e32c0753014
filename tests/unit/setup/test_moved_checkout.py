"""A checkout that was set up works where it is moved or copied to, without a compiler; its name may have an umlaut."""

import itertools
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from unit.setup.small_checkout import SmallCheckout

SAID = "this checkout or its environment was in another folder"


def holding(folder: Path, old: Path) -> list[str]:
    """Files and links in a folder that name another one; not those that only tell what was done."""
    name, found = re.compile(re.escape(os.fsencode(old)) + rb"(?![\w-])"), []
    for path in folder.rglob("*"):
        if path.is_symlink():
            held = name.search(os.fsencode(os.readlink(path)))
        else:
            held = path.is_file() and name.search(path.read_bytes())
        if held and not {"log", "__pycache__"} & {*path.parts} and path.suffix != ".log":
            found.append(str(path.relative_to(folder)))
    return found


def output(*command: object) -> str:
    return subprocess.run([*map(str, command)], capture_output=True, encoding="utf-8", check=True).stdout


@pytest.mark.slow
def test_a_checkout_is_moved_and_copied_and_nothing_of_the_old_folder_is_used(
    tmp_path: Path, repository: Path
) -> None:
    checkout = SmallCheckout(tmp_path, repository, root="here", venv="here/.venv")
    checkout.complete()
    libraries = sorted(path.name for path in (checkout.venv / "lib").glob("lib*.so"))
    places = [tmp_path / name for name in ("here", "Bücher und/there", "Bücher und/there-2", "Bücher")]
    for old, new in itertools.pairwise(places):
        new.parent.mkdir(exist_ok=True)
        if new == places[2]:
            shutil.copytree(old, new, symlinks=True)
            shutil.rmtree(old)
        else:
            shutil.move(old, new)
        checkout.go_to(new)
        before = checkout.log.stat().st_size
        said = checkout.complete()
        assert SAID in said and "setting up" not in said
        assert b"colcon" not in checkout.log.read_bytes()[before:], "nothing is compiled again"
        assert holding(new, old) == []
        assert sorted(path.name for path in (checkout.venv / "lib").glob("lib*.so") if path.exists()) == libraries
        assert str(checkout.venv) in output(checkout.venv / "bin" / "pip", "--version")
        assert output("sh", "-c", f". '{checkout.venv}/bin/activate'; command -v pip") == f"{checkout.venv}/bin/pip\n"
        assert checkout.complete() == ""


@pytest.mark.slow
def test_messages_are_built_in_a_folder_with_an_umlaut_and_again_where_they_changed_after_a_move(
    tmp_path: Path, repository: Path
) -> None:
    checkout = SmallCheckout(tmp_path, repository, root="Größe 1", venv="Größe 1/.venv")
    assert "building wm_msgs" in checkout.complete()
    shutil.move(checkout.root, tmp_path / "Größe 2")
    checkout.go_to(tmp_path / "Größe 2")
    (checkout.root / "msgs_schema/package.xml").open("a").write("<!-- changed -->")
    said = checkout.complete()
    assert SAID in said and "setting up messages;" in said and "building wm_msgs" in said


@pytest.mark.slow
def test_an_environment_elsewhere_follows_the_checkout_that_used_it_last(tmp_path: Path, repository: Path) -> None:
    checkout = SmallCheckout(tmp_path, repository)
    checkout.complete()
    copy = shutil.copytree(checkout.root, tmp_path / "copy", symlinks=True)
    checkout.root = copy
    said = checkout.complete()
    assert SAID in said and "setting up" not in said
    checkout.root = tmp_path / "checkout"
    assert SAID in checkout.complete()


@pytest.mark.slow
def test_messages_that_came_along_in_a_copy_are_not_compiled_again_for_an_environment_of_its_own(
    tmp_path: Path, repository: Path
) -> None:
    checkout = SmallCheckout(tmp_path, repository)
    checkout.complete()
    old, old_venv = checkout.root, checkout.venv
    checkout.root = shutil.copytree(old, tmp_path / "Bücher und" / "copy", symlinks=True)
    checkout.venv, checkout.log = tmp_path / "second", tmp_path / "second_setup.log"
    checkout.environment["WM_VENV"] = str(checkout.venv)
    said = checkout.complete()
    assert "building tf2_msgs" in said and "wm_msgs, the message types" not in said
    commands = [line for line in checkout.log.read_text("utf-8").splitlines() if "-m colcon" in line]
    assert len(commands) == 1 and "/tf2_msgs " in commands[0]
    assert holding(checkout.root, old) == holding(checkout.root, old_venv) == []
    assert checkout.complete() == ""
    (checkout.root / "msgs_schema/package.xml").open("a").write("<!-- changed -->")
    assert "building wm_msgs" in checkout.complete()
