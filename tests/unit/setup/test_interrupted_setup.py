"""A set-up that was interrupted is repaired by the next start, wherever it stopped: real commands, small packages."""

import os
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from deadlines import PATIENCE_S
from unit.setup.small_checkout import SmallCheckout

from setup import console, stamp

COMMANDS = {
    "-m venv": 1.5, "pip install --disable": 0.4, "torch-cpu.txt": 0.05, "lock.txt": 0.1, "colcon": 1.2,
    "wm_msgs/tf2_msgs": 0.8, "wm_nodes": 0.3,
}
"""Commands of the set-up in their order -> within how many seconds of its start each is interrupted."""
HOW = ("INT", "TERM", "KILL", "KILL ALL")
TORN_STEPS = ("packages", "torch", "messages")


def tear(file: Path, last: bytes) -> None:
    """Replace a file by its first half, up to and with the next `last`, newer than all others."""
    content = file.read_bytes()
    file.unlink()
    file.write_bytes(content[: content.index(last, len(content) // 2) + len(last)])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2026])
def test_ten_interruptions_and_a_full_disk_leave_what_the_next_start_repairs(
    seed: int, tmp_path: Path, repository: Path
) -> None:
    checkout, draw = SmallCheckout(tmp_path, repository), random.Random(seed)
    full = checkout.start(limit=100_000)
    _, err = full.communicate()
    assert full.returncode == 1 and "creating the virtual environment failed" in err
    said, interrupted = "", 0
    for word in sorted(["-m venv", *draw.choices(list(COMMANDS), k=9)], key=list(COMMANDS).index):
        point = word, draw.uniform(0, COMMANDS[word]), draw.choice(HOW)
        code, err = checkout.interrupt(*point)
        said += err
        if "[set-up] done" in err or (code, err) == (0, ""):
            continue  # it was quicker, now or before
        interrupted += 1
        if point[2] in {"INT", "TERM"}:
            last = err.splitlines()[-1:]
            says = "interrupted; start again to continue where the set-up stopped"
            assert (code, last) == (130, [says]), (point, err)
            assert "Traceback" not in err and not checkout.processes() and not checkout.locked(), point
        else:
            assert code == -9, (point, err)
    assert interrupted >= 5
    checkout.complete()
    assert f"{checkout.venv} was begun and not finished: making it again" in said
    assert checkout.complete() == ""


@pytest.mark.slow
def test_torn_packages_and_a_torn_build_are_made_again_in_an_environment_whose_other_files_stay(
    tmp_path: Path, repository: Path
) -> None:
    """Each file is left as a killed pip, uv, compiler or colcon leaves it; the user's own environment has no pip."""
    checkout = SmallCheckout(tmp_path, repository)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(checkout.venv)], check=True)
    (checkout.venv / "mine.txt").write_text("mine")
    checkout.complete()
    site = next(checkout.venv.glob("lib/python3.*/site-packages"))
    assert '"/opt/python' not in (checkout.venv / "share/parts/export.cmake").read_text()
    lost = [site / "setuptools/archive_util.py", site / "torch/__init__.py", checkout.venv / "bin/uv",
            checkout.venv / "lib/libwm_msgs.so", checkout.venv / "lib/libtf2_msgs.so"]
    for path in lost:
        path.unlink()
    build, install = (checkout.root / "ros2_ws" / name / "wm_msgs" for name in ("build", "install"))
    torn = [(site / "parts-1.0.dist-info/RECORD", b"\n"), (next(site.glob("setuptools-*")) / "RECORD", b"/"),
            (install / "lib/libwm_msgs.so", b""), (next(build.rglob("two.c.o")), b""),
            (checkout.venv / "tf2_msgs/install/tf2_msgs/lib/libtf2_msgs.so", b""),
            (next((checkout.venv / "tf2_msgs/build").rglob("two.c.o")), b"")]
    sizes = [path.stat().st_size for path, _ in torn]
    for path, last in torn:
        tear(path, last)
    for step in TORN_STEPS:
        stamp.begin(checkout.venv, step)
    said = checkout.complete()
    assert "packages did not finish: installing all" in said and "wm_msgs did not finish: building it" in said
    assert all(path.exists() for path in lost) and [path.stat().st_size for path, _ in torn] == sizes
    tear(next(site.glob("wm_nodes-*.dist-info")) / "RECORD", b"/")
    stamp.begin(checkout.venv, "wm_nodes")
    checkout.complete()
    assert (checkout.venv / "mine.txt").read_text() == "mine"


@pytest.mark.slow
def test_a_lost_tf2_msgs_is_built_again_and_one_that_the_environment_has_is_left_alone(
    tmp_path: Path, repository: Path
) -> None:
    checkout = SmallCheckout(tmp_path, repository)
    assert "and tf2_msgs for the frames of cameras" in checkout.complete()
    folder, site = checkout.venv / "tf2_msgs", next(checkout.venv.glob("lib/python3.*/site-packages"))
    assert folder in checkout.tf2_msgs().parents
    assert os.listdir(checkout.root / "ros2_ws/install").count("tf2_msgs") == 0, "it would hide ROS 2's own"
    shutil.rmtree(folder)
    said = checkout.complete()
    assert "setting up messages;" in said and folder in checkout.tf2_msgs().parents
    shutil.rmtree(folder)
    (site / "tf2_msgs/msg").mkdir(parents=True)
    (site / "tf2_msgs/msg/__init__.py").write_text("TFMessage = ...\n")
    said = checkout.complete()
    assert "setting up messages;" in said and "and tf2_msgs" not in said and not folder.exists()
    assert checkout.tf2_msgs() == site / "tf2_msgs/msg/__init__.py"
    assert checkout.complete() == ""


def test_commands_of_a_killed_set_up_keep_its_lock_until_they_end(tmp_path: Path, repository: Path) -> None:
    checkout = SmallCheckout(tmp_path, repository)
    checkout.interrupt("-m venv", 0.2, "KILL")
    assert checkout.locked()
    until = time.monotonic() + PATIENCE_S
    while checkout.processes() or checkout.locked():  # a process that ends has no environment before it has no files
        assert time.monotonic() < until, checkout.processes()
        time.sleep(0.05)


def test_a_folder_that_is_no_environment_is_refused_and_left_alone(tmp_path: Path, repository: Path) -> None:
    checkout = SmallCheckout(tmp_path, repository)
    checkout.venv.mkdir()
    (checkout.venv / "thesis.txt").write_text("mine")
    refused = checkout.start()
    _, err = refused.communicate()
    assert refused.returncode == 1 and err.splitlines()[-1].startswith(f"error: {checkout.venv} is not empty")
    assert os.listdir(checkout.venv) == ["thesis.txt"]


def test_processes_that_ignore_ctrl_c_are_ended_with_all_that_they_started(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "PATIENCE_S", 0.2)
    command = ["sh", "-c", "trap '' INT; sleep 60 & echo; wait"]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True)
    assert child.stdout and child.stdout.readline() and console._group_lives(child.pid)
    console._end_group(child)
    assert child.returncode == -9 and not console._group_lives(child.pid)
