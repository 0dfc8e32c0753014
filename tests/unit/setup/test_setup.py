"""The set-up's decisions, on temporary trees: nothing is installed here."""

import json
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest
import run_tests
import torch

import setup
from setup import entry, interpreter, messages, packages, place, stamp
from setup.console import SetupError, isolated_environment, run


def test_cmake_repair_replaces_the_wheel_builders_folders_and_nothing_else(tmp_path: Path) -> None:
    old = "/opt/python/cp312-cp312/include/python3.12;/opt/python/cp312-cp312/lib/python3.12/site-packages"
    broken = tmp_path / "std_msgs" / "cmake" / "export.cmake"
    broken.parent.mkdir(parents=True)
    broken.write_text(f'set(dirs "{old}/numpy/_core/include;/opt/python/other")\n')
    healthy = tmp_path / "fine.cmake"
    healthy.write_text("set(dirs /usr/include)\n")
    before = healthy.stat().st_mtime_ns
    listing = tmp_path / "rosidl_adapt_interfaces.cmake"
    listing.write_text('  file(STRINGS "${idl_output}" idl_tuples)\n')
    cached = tmp_path / "cached"
    cached.hardlink_to(broken)
    assert messages.repair_cmake(tmp_path, "/py/include", "/np/include") == 2
    assert listing.read_text() == '  file(STRINGS "${idl_output}" idl_tuples ENCODING UTF-8)\n', "paths with an umlaut"
    assert "/opt/python/cp312" in cached.read_text(), "what other environments are installed from stays as it is"
    assert broken.read_text() == 'set(dirs "/py/include;/np/include;/opt/python/other")\n'
    assert healthy.stat().st_mtime_ns == before
    assert messages.repair_cmake(tmp_path, "/py/include", "/np/include") == 0


def test_cmake_file_stays_whole_where_its_repair_fails(tmp_path: Path) -> None:
    file = tmp_path / "export.cmake"
    file.write_text("/opt/python/cp312-cp312/include/python3.12")
    (tmp_path / "export.tmp").mkdir()
    with pytest.raises(OSError, match="Is a directory"):
        messages.repair_cmake(tmp_path, "/py/include", "/np/include")
    assert file.read_text() == "/opt/python/cp312-cp312/include/python3.12"


def test_what_was_begun_is_not_trusted_until_it_is_finished(tree: Path) -> None:
    venv = tree / ".venv"
    assert not stamp.begin(venv, "messages") and entry.pending(venv) == ["messages"]
    assert stamp.begin(venv, "messages"), "an earlier start began it"
    stamp.finish(venv, {"messages": entry._wanted(venv)["messages"]})
    assert entry.pending(venv) == [] and not stamp.begin(venv, "messages")


def test_live_environment_has_no_unrepaired_cmake_file() -> None:
    share = Path(sys.prefix) / "share"
    left = [path for path in share.rglob("*.cmake") if "/opt/python/cp3" in path.read_text(errors="replace")]
    assert not left


def test_fingerprint_changes_with_content_name_and_extra(tmp_path: Path) -> None:
    file = tmp_path / "a.msg"
    file.write_text("uint8 a\n")
    first = stamp.fingerprint([file], "x")
    assert stamp.fingerprint([file], "x") == first
    assert stamp.fingerprint([file], "y") != first
    file.write_text("uint8 b\n")
    assert stamp.fingerprint([file], "x") != first
    file.write_text("uint8 a\n")
    assert stamp.fingerprint([file.rename(tmp_path / "b.msg")], "x") != first


def test_stamp_that_is_torn_or_foreign_counts_as_absent(tmp_path: Path) -> None:
    file = tmp_path / "stamp.json"
    assert stamp.read_stamp(file) == {}
    file.write_text('{"packages": "12')
    assert stamp.read_stamp(file) == {}
    file.write_text("[1]")
    assert stamp.read_stamp(file) == {}
    stamp.write_stamp(file, {"packages": "12"})
    assert stamp.read_stamp(file)["packages"] == "12"


def test_python_version_is_the_environments_not_the_running_one(tmp_path: Path) -> None:
    (tmp_path / "pyvenv.cfg").write_text("home = /usr/bin\nversion = 3.12.9\n")
    assert stamp.python_version(tmp_path) == "3.12.9"


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with one requirement and one message, and a finished set-up."""
    root = tmp_path / "repo"
    for name, text in {
        "requirements/core.txt": "numpy\n", "msgs_schema/CMakeLists.txt": "", "msgs_schema/package.xml": "",
        "msgs_schema/msg/A.msg": "uint8 a\n",
        **{f"msgs_schema/tf2_msgs/{name}": "" for name in ("CMakeLists.txt", "package.xml", "msg/TFMessage.msg")},
        "wm_nodes/setup.py": "", "wm_nodes/setup.cfg": "",
        "wm_nodes/pyproject.toml": "", "launch_scripts/setup/system.py": "", ".venv/bin/python": "",
        "ros2_ws/install/wm_msgs/share/wm_msgs/package.xml": "",
    }.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    monkeypatch.setattr(entry, "ROOT", root)
    monkeypatch.setattr(entry, "REQUIREMENTS", root / "requirements")
    monkeypatch.setattr(entry, "MESSAGES", root / "msgs_schema")
    monkeypatch.setattr(entry, "PACKAGE", root / "wm_nodes")
    monkeypatch.setattr(entry, "WORKSPACE", root / "ros2_ws")
    venv = root / ".venv"
    stamp.write_stamp(venv / "wm_setup_stamp.json", entry._wanted(venv))
    stamp.write_stamp(root / "ros2_ws/install/wm_msgs" / entry.SOURCES, entry._wanted(venv))
    assert entry.pending(venv) == []
    return root


def test_new_message_rebuilds_messages_only(tree: Path) -> None:
    (tree / "msgs_schema/msg/B.msg").write_text("uint8 b\n")
    assert entry.pending(tree / ".venv") == ["messages"]


@pytest.mark.parametrize("name", ["CMakeLists.txt", "package.xml", "msg/TFMessage.msg"])
def test_changed_tf2_msgs_rebuilds_messages_only(name: str, tree: Path) -> None:
    (tree / "msgs_schema/tf2_msgs" / name).write_text("# other\n")
    assert entry.pending(tree / ".venv") == ["messages"]


def test_new_requirement_redoes_all_that_stands_on_it(tree: Path) -> None:
    (tree / "requirements/core.txt").write_text("numpy\nscipy\n")
    assert entry.pending(tree / ".venv") == ["packages", "messages", "wm_nodes"]


def test_lost_build_is_noticed_despite_the_stamp(tree: Path) -> None:
    (tree / "ros2_ws/install/wm_msgs/share/wm_msgs/package.xml").unlink()
    assert entry.pending(tree / ".venv") == ["messages"]


def test_lost_tf2_msgs_is_noticed_where_it_was_built_here(tree: Path) -> None:
    link = tree / ".venv/share/tf2_msgs"
    link.parent.mkdir()
    link.symlink_to(tree / "built")
    assert entry.pending(tree / ".venv") == ["messages"]
    (tree / "built").mkdir()
    assert entry.pending(tree / ".venv") == []


def test_absent_renderer_is_not_tried_again_at_every_start(tree: Path) -> None:
    file = tree / ".venv/wm_setup_stamp.json"
    values = json.loads(file.read_text())
    file.write_text(json.dumps({**values, "renderer": values["renderer"] + entry.MISSING}))
    assert entry.pending(tree / ".venv") == []


def test_unsupported_python_is_named_with_the_remedy() -> None:
    assert not interpreter.supported((3, 10, 4)) and not interpreter.supported((3, 13, 0))
    text = interpreter.unsupported_message((3, 13, 1))
    assert "3.13.1" in text and "apt-get install python3" in text


def fake_python(path: Path, version: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\necho {version}\n" if version else "#!/bin/sh\nexit 127\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)


def test_a_pyenv_version_is_found_where_the_shim_on_path_does_not_work(tmp_path: Path) -> None:
    fake_python(tmp_path / "shims/python3.12", "")
    assert interpreter.find_supported(str(tmp_path / "shims"), str(tmp_path / "none")) is None
    fake_python(tmp_path / "pyenv/versions/3.12.4/bin/python3.12", "3 12")
    found = interpreter.find_supported(str(tmp_path / "shims"), str(tmp_path / "pyenv"))
    assert found == str(tmp_path / "pyenv/versions/3.12.4/bin/python3.12")


def test_entry_points_are_readable_for_old_pythons(repository: Path) -> None:
    import ast

    for name in ("setup/entry.py", "online_rl.py", "run_tests.py", "setup/__main__.py", "setup/interpreter.py"):
        ast.parse((repository / "launch_scripts" / name).read_text(), feature_version=(3, 8))


@pytest.mark.slow
def test_a_graph_test_that_failed_beside_another_has_to_pass_by_itself_and_others_are_not_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run_tests, "ROOT", tmp_path)
    for folder in ("graph", "unit"):
        (tmp_path / "tests" / folder).mkdir(parents=True)
    body = """
from pathlib import Path

def test_one():
    with Path("{0}").open("a+") as runs:
        assert runs.write(".") and runs.tell() > {1}
"""
    second, never, unit = (tmp_path / "tests" / name for name in (
        "graph/test_second.py", "graph/test_never.py", "unit/test_unit.py"
    ))
    for path, passes_after in ((second, 1), (never, 99), (unit, 1)):
        path.write_text(body.format(tmp_path / path.stem, passes_after))

    def first(*paths: Path) -> None:
        names = [str(path.relative_to(tmp_path)) for path in paths]
        run_tests.forget()
        assert run_tests._pytest(["-q", "-p", "no:xdist", *names]) == 1

    first(second)
    capfd.readouterr()
    assert run_tests.repeated() == 0
    assert "once more, by themselves:\n  tests/graph/test_second.py::test_one" in capfd.readouterr().out
    first(never)
    assert run_tests.repeated() == 1
    first(unit)
    assert run_tests.repeated() == 1 and (tmp_path / "test_unit").read_text() == "."


HANGS = """
import ctypes
from pathlib import Path

def test_hang():
    with Path("{0}").open("a+") as runs:
        if runs.write(".") and runs.tell() <= {1}:
            mutex = ctypes.create_string_buffer(64)
            while True:
                ctypes.CDLL(None).pthread_mutex_lock(mutex)

def test_after():
    pass
"""
PLUGIN = """
from importlib.util import module_from_spec, spec_from_file_location

spec = spec_from_file_location("conftest_of_all", "{0}")
module = module_from_spec(spec)
spec.loader.exec_module(module)
pytest_handlecrashitem = module.pytest_handlecrashitem
"""


@pytest.mark.slow
def test_a_graph_test_that_hangs_inside_a_library_ends_and_has_to_pass_by_itself(
    tmp_path: Path, repository: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run_tests, "ROOT", tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(repository / "tests"))
    (tmp_path / "conftest.py").write_text(PLUGIN.format(repository / "tests/conftest.py"))
    (tmp_path / "tests/graph").mkdir(parents=True)
    test = tmp_path / "tests/graph/test_hangs.py"
    limits = ["--timeout=1", "-o", "faulthandler_timeout=3", "-o", "faulthandler_exit_on_timeout=true"]
    for hangs, crashes, code in ((1, 1, 0), (99, run_tests.MOST_CRASHES + 1, 1)):
        test.write_text(HANGS.format(tmp_path / f"runs_{hangs}", hangs))
        run_tests.forget()
        assert run_tests._pytest(["-q", *limits, *run_tests.BY_FILE, "tests/graph"]) == 1
        assert capfd.readouterr().out.count("crashed while running") >= crashes
        assert run_tests.repeated() == code
    assert len((tmp_path / "runs_1").read_text()) == 3, "it hung, ran in another process, and by itself"


def test_tests_keep_compiled_modules_and_repeat_nothing_whatever_the_users_shell_says(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("PYTHONDONTWRITEBYTECODE", "WM_TEST_RERUNS"):
        monkeypatch.setenv(name, "1")
    assert not {"PYTHONDONTWRITEBYTECODE", "WM_TEST_RERUNS"} & run_tests._environment().keys()


def test_the_tests_of_a_device_can_be_run_on_a_gpu_and_say_that_there_is_none(
    capfd: pytest.CaptureFixture[str]
) -> None:
    some = "tests/unit/core/test_pretended_device.py"
    assert run_tests.main(["--device", "cuda", "-p", "no:cacheprovider", some]) == 0
    out = capfd.readouterr().out
    assert re.search(r"1 passed, \d+ deselected" if torch.cuda.is_available() else r"1 skipped, \d+ deselected", out)
    assert torch.cuda.is_available() or re.search(r"SKIPPED .*no GPU: torch \S+ sees none, and --device cuda asks", out)


def test_sourced_ros_and_other_environments_do_not_leak_into_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "other"
    (other / "lib").mkdir(parents=True)
    (other / "pyvenv.cfg").write_text("")
    monkeypatch.setenv("LD_LIBRARY_PATH", f"/opt/ros/jazzy/lib:{other}/lib:/usr/local/cuda/lib64")
    monkeypatch.setenv("PYTHONPATH", "/opt/ros/jazzy/lib/python3.12/site-packages")
    monkeypatch.setenv("PATH", f"/opt/ros/jazzy/bin:{other}/bin:/usr/bin")
    monkeypatch.setenv("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "1")
    env = isolated_environment(tmp_path / "repo" / ".venv")
    assert env["LD_LIBRARY_PATH"] == "/usr/local/cuda/lib64"
    assert "PYTHONPATH" not in env and "_ROS_WHEELS_BOOTSTRAP_COMPLETE" not in env
    assert env["PATH"].split(os.pathsep) == [str(tmp_path / "repo/.venv/bin"), "/usr/bin"]


def test_failed_command_shows_its_last_lines_and_the_log(tmp_path: Path) -> None:
    with pytest.raises(SetupError, match=r"(?s)drawing failed \(exit code 3\).*no ink.*setup\.log"):
        run(["sh", "-c", "echo no ink; exit 3"], log=tmp_path / "setup.log", why="drawing")


@pytest.mark.parametrize(("text", "expected"), [("2.13.0+cpu\n", (2, 13)), ("2.8.0a0+git1", (2, 8)), ("2.7.1", (2, 7))])
def test_torch_version_is_compared_as_numbers(text: str, expected: tuple[int, int]) -> None:
    assert packages.parse_version(text) == expected
    assert (expected >= packages.MIN_TORCH) == (expected != (2, 7))


def test_check_of_the_live_tree_answers_quickly_and_changes_nothing(repository: Path) -> None:
    command = [sys.executable, str(repository / "launch_scripts/setup"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout.strip(), done.stderr
    assert "missing" in done.stdout or done.stdout.strip() == "complete"


@pytest.mark.slow
def test_installed_package_brings_every_data_file(repository: Path, tmp_path: Path) -> None:
    """colcon and a plain pip install copy; what is missing there is not missed in an editable install."""
    source = tmp_path / "wm_nodes"
    ignored = shutil.ignore_patterns("build", "*.egg-info", "__pycache__")
    shutil.copytree(repository / "wm_nodes", source, ignore=ignored)
    command = [sys.executable, "setup.py", "-q", "build", "--build-base", str(tmp_path / "build")]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    built = tmp_path / "build" / "lib"
    kinds = {".yaml", ".xml", ".json", ".safetensors", ".py", ".txt", ".typed"}
    files = [path for path in (source / "wm_nodes").rglob("*") if path.suffix in kinds]
    absent = [str(path.relative_to(source)) for path in files if not (built / path.relative_to(source)).exists()]
    assert not absent


def test_uv_sees_the_indexes_that_pip_is_configured_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PIP_INDEX_URL", "PIP_EXTRA_INDEX_URL", "PIP_FIND_LINKS", "UV_DEFAULT_INDEX", "UV_FIND_LINKS"):
        monkeypatch.delenv(name, raising=False)
    file = tmp_path / "pip.conf"
    file.write_text("[global]\nindex-url = https://mirror/simple\nfind-links =\n    /a\n    /b\n")
    monkeypatch.setenv("PIP_CONFIG_FILE", str(file))
    monkeypatch.setenv("UV_INDEX", "https://mine/simple")
    seen = packages._indexes(sys.executable)
    assert seen["UV_DEFAULT_INDEX"] == "https://mirror/simple" and seen["UV_FIND_LINKS"] == "/a,/b"
    assert "UV_INDEX" not in seen, "what the user set for uv stays"


def test_the_lock_pins_what_the_requirements_name_and_leaves_torch_to_the_machine(repository: Path) -> None:
    folder = repository / "requirements"
    lock = {line.split(";")[0].strip().lower() for line in (folder / "lock.txt").read_text().splitlines()}
    named = [
        re.sub(r"\[.*\]", "", line).strip().lower()
        for name in ("core", "ros", "dev", "video", "judge")
        for line in (folder / f"{name}.txt").read_text().splitlines()
        if "==" in line
    ]
    assert len(named) > 40 and set(named) <= lock
    assert not any(line.startswith(("torch==", "opencv-python==", "nvidia-cu")) for line in lock)


def test_ctrl_c_from_the_first_line_of_a_start_on_is_one_line(
    tree: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """While Python starts again in the environment the signal waits, for it would be a traceback there."""
    def interrupted(python: str, arguments: list[str], environment: dict[str, str]) -> None:
        assert signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
        raise KeyboardInterrupt

    monkeypatch.setattr(entry, "venv_folder", lambda: tree / ".venv")
    monkeypatch.setattr(os, "execve", interrupted)
    try:
        for start, argument in ((setup.ensure, ["collect"]), (setup.launch, "evaluate")):
            with pytest.raises(SystemExit, match="130"):
                start(argument)
            assert capsys.readouterr().err == "interrupted\n"
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])


@pytest.mark.parametrize("name", [".venv", "ros2_ws/install"])
def test_a_link_into_another_checkout_is_refused_in_one_line_and_nothing_is_changed_there(
    name: str, repository: Path, tmp_path: Path
) -> None:
    ours, other = tmp_path / "ours", tmp_path / "other"
    for root in (ours, other):
        shutil.copytree(repository / "launch_scripts", root / "launch_scripts")
    (other / name).mkdir(parents=True)
    (ours / name).parent.mkdir(exist_ok=True)
    (ours / name).symlink_to(other / name)
    environment = {key: value for key, value in os.environ.items() if key != "WM_VENV"}
    for script in ("wm.py", "online_rl.py", "setup", "evaluate.launch.py"):
        command = [sys.executable, str(ours / "launch_scripts" / script)]
        if script == "wm.py":
            command += ["view", "bag"]
        done = subprocess.run(command, env=environment, capture_output=True, encoding="utf-8", check=False)
        assert done.returncode == 1 and done.stderr == (
            f"error: {ours / name} is a link into another checkout, whose environment the set-up would make that of "
            f"this one; remove the link, or work in {other}\n"
        )
    assert [*(other / name).iterdir()] == [] and not (other / ".venv_setup.log").exists()


def test_an_environment_that_a_link_puts_on_another_disk_is_no_other_checkout(tmp_path: Path) -> None:
    (tmp_path / "disk" / "venv").mkdir(parents=True)
    (tmp_path / "checkout" / "launch_scripts" / "setup").mkdir(parents=True)
    link = tmp_path / "checkout" / ".venv"
    link.symlink_to(tmp_path / "disk" / "venv")
    place.refuse_links(tmp_path / "checkout", (link, tmp_path / "absent"))


@pytest.mark.parametrize("target", ["absent", "itself"])
def test_a_link_that_leads_nowhere_is_refused_in_one_line(target: str, tmp_path: Path) -> None:
    link = tmp_path / "itself"
    link.symlink_to(tmp_path / target)
    with pytest.raises(place.SetupError, match="itself is a link that leads nowhere; remove it"):
        place.refuse_links(tmp_path, (link,))
