"""The runner with real processes and real DDS."""

import io
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from deadlines import within

from wm_nodes.launching import readiness
from wm_nodes.launching import runner as launching_runner
from wm_nodes.launching.domain_lock import DomainInUseError
from wm_nodes.launching.graph import Graph, NodeSpec
from wm_nodes.launching.readiness import NotReadyError
from wm_nodes.launching.runner import NodeDiedError, Runner

pytestmark = [pytest.mark.graph, pytest.mark.alone]
TESTS = Path(__file__).resolve().parents[1]


def tiny(name: str, **parameters: object) -> NodeSpec:
    return NodeSpec("graph.tiny_node", name, "/wm", parameters, lifecycle=False)


def graph(*nodes: NodeSpec) -> Graph:
    path = os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])
    return Graph("tiny", nodes, {"PYTHONPATH": path})


@pytest.fixture(params=[True, False])
def forks(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether nodes fork, as several do; else each is an interpreter of its own."""
    if not request.param:
        monkeypatch.setattr(launching_runner, "_can_fork", lambda node: False)
    return bool(request.param)


def state_and_parent(pid: int) -> list[str]:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[:2]


def parent(pid: int) -> int:
    return int(state_and_parent(pid)[1])


def alive(pid: int) -> bool:
    """A zombie is not: whoever inherits an orphan may take its time to look after it."""
    try:
        return state_and_parent(pid)[0] != "Z"
    except FileNotFoundError:
        return False


def test_nodes_start_become_ready_and_end_without_a_trace(ros_domain: int, tmp_path: Path, forks: bool) -> None:
    log = io.StringIO()
    with Runner(graph(tiny("a", text="1"), tiny("b")), log=log, log_dir=tmp_path) as runner:
        runner.wait_ready(30)
        pids = [runner.process("a").pid, runner.process("wm/b").pid]
        assert all(os.getpgid(pid) == pid for pid in pids)
        assert all((parent(pid) == os.getpid()) != forks for pid in pids)
        assert all("-m\0graph.tiny_node\0" in Path(f"/proc/{pid}/cmdline").read_text() for pid in pids)
        assert runner.failure() is None
    assert not any(alive(pid) for pid in pids)
    assert [runner.process(name).wait(10) for name in "ab"] == [0, 0]
    assert f"[wm/a] tiny says '1' on domain {ros_domain}" in log.getvalue()
    assert "tiny says '1'" in (tmp_path / "wm.a.log").read_text()


def test_end_of_a_required_node_is_reported_with_its_last_words_and_code(ros_domain: int, forks: bool) -> None:
    log = io.StringIO()
    with Runner(graph(tiny("short", die_after_s=1.0), tiny("long")), log=log) as runner:
        assert runner.wait(timeout_s=60) == 7
        with pytest.raises(NodeDiedError, match="required node wm/short ended with code 7: tiny gives up"):
            runner.check()
    assert "[runner] required node wm/short ended with code 7" in log.getvalue()


@pytest.mark.kills
def test_death_by_sigkill_is_reported_within_five_seconds(ros_domain: int, forks: bool) -> None:
    with Runner(graph(tiny("a"), tiny("b")), log=None) as runner:
        runner.wait_ready(30)
        os.kill(runner.process("b").pid, signal.SIGKILL)
        since = time.monotonic()
        assert runner.wait(timeout_s=30) == 128 + signal.SIGKILL
        assert time.monotonic() - since < within(5.0)


@pytest.mark.kills
def test_a_node_that_is_to_respawn_comes_back_and_one_that_ends_at_once_does_not(
    ros_domain: int, forks: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launching_runner, "LEAST_LIFE_S", 2.0)
    nodes = [replace(tiny(name), respawn=True) for name in "ab"]
    log = io.StringIO()
    with Runner(graph(*nodes), log=log) as runner:
        runner.wait_ready(30)
        time.sleep(2.0)
        first = runner.process("a").pid
        os.kill(first, signal.SIGKILL)
        assert runner.wait(timeout_s=15, until=lambda: runner.process("a").pid != first) == 0
        assert runner.process("a").pid != first and runner.failure() is None
        assert "required node wm/a was ended by SIGKILL" in log.getvalue() and "starting it again" in log.getvalue()
        os.kill(runner.process("a").pid, signal.SIGKILL)
        assert runner.wait(timeout_s=30) == 128 + signal.SIGKILL


@pytest.mark.kills
def test_node_that_ignores_sigint_and_sigterm_is_killed_in_the_end(ros_domain: int) -> None:
    log = io.StringIO()
    with Runner(graph(tiny("a", stubborn=True)), log=log) as runner:
        runner.wait_ready(30)
        pid = runner.process("a").pid
        since = time.monotonic()
    assert not alive(pid) and "killed, because 10 s were not enough: wm/a" in log.getvalue()
    assert time.monotonic() - since < within(20)


@pytest.mark.kills
def test_nodes_end_with_their_fork_server_and_come_back_without_it(
    ros_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launching_runner, "LEAST_LIFE_S", 0.0)
    with Runner(graph(*(replace(tiny(name), respawn=True) for name in "ab")), log=None) as runner:
        runner.wait_ready(30)
        nodes = [runner.process("a"), runner.process("b")]
        pids = [node.pid for node in nodes]
        assert parent(pids[0]) == parent(pids[1])
        os.kill(parent(pids[0]), signal.SIGKILL)
        assert runner.wait(timeout_s=30, until=lambda: not {node.pid for node in nodes} & {*pids}) == 0
        assert parent(nodes[0].pid) == os.getpid()
        assert not any(alive(pid) for pid in pids)


def test_second_runner_on_the_domain_is_refused(ros_domain: int) -> None:
    with Runner(graph(tiny("a")), log=None):
        with pytest.raises(DomainInUseError, match=f"ROS domain {ros_domain} is already in use.*graph 'tiny'"):
            Runner(graph(tiny("b")), log=None).start()


def test_node_that_never_appears_is_named(ros_domain: int) -> None:
    silent = NodeSpec("timeit", "absent", lifecycle=False, arguments=("-n1", "-r1", "import time; time.sleep(60)"))
    with Runner(graph(silent), log=None) as runner:
        with pytest.raises((NotReadyError, NodeDiedError), match="absent"):
            runner.wait_ready(3)


def test_node_that_never_becomes_active_is_named_with_its_last_words(
    ros_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(readiness, "OBSERVER_S", 1.0)  # so that a second participant looks, too
    with Runner(graph(replace(tiny("a", text="good morning"), lifecycle=True), tiny("b")), log=None) as runner:
        with pytest.raises(NotReadyError, match=r"after 12 s: /wm/a \(seen\): tiny says 'good morning'"):
            runner.wait_ready(12)


def test_ctrl_c_ends_all_nodes_and_the_starter_with_code_0(ros_domain: int, tmp_path: Path) -> None:
    script = tmp_path / "start.py"
    script.write_text(
        "import sys; from pathlib import Path\n"
        "from graph.test_runner import graph, tiny\n"
        "from wm_nodes.launching.runner import run\n"
        "sys.exit(run(graph(tiny('a'), tiny('b')), Path(sys.argv[1])))\n"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])}
    process = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path)], env=env, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if "ready; Ctrl-C stops" in line:
            break
    os.killpg(process.pid, signal.SIGINT)
    process.stdout.read()
    assert process.wait(timeout=30) == 0, "".join(lines)


SHOWN = "import faulthandler, signal; faulthandler.register(signal.SIGUSR1); "
"""So that a start that does not end shows where it is."""
START = "from wm_nodes.launching.start import start; print('begun', flush=True); sys.exit(start('online_training'))"
VERB = (
    "from wm_nodes.apps.cli import run_verb; print('begun', flush=True); "
    "sys.exit(run_verb('train-policy', sys.argv[1:], 'wm'))"
)


@pytest.mark.parametrize("moment_s", [0.0, 0.2, 0.5, 1.0, 2.0, 3.0])
@pytest.mark.parametrize(
    ("program", "given"), [(START, ["preset:=smoke", "run_dir:={}"]), (VERB, ["--preset", "smoke", "--run-dir", "{}"])]
)
def test_ctrl_c_in_the_first_seconds_of_a_start_ends_it_with_one_line_and_code_130(
    ros_domain: int, tmp_path: Path, program: str, given: list[str], moment_s: float
) -> None:
    words = [word.format(tmp_path / "run") for word in given]
    command = [sys.executable, "-c", f"import sys; {SHOWN}{program}", *words]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    assert process.stdout is not None and process.stdout.readline() == "begun\n"
    time.sleep(moment_s)
    os.killpg(process.pid, signal.SIGINT)
    try:
        said, _ = process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGUSR1)
        time.sleep(1.0)
        os.killpg(process.pid, signal.SIGKILL)
        said, _ = process.communicate()
        pytest.fail(f"it has not ended:\n{said}")
    assert process.returncode == 130 and said.count("interrupted") == 1 and "Traceback" not in said, said
    assert "interrupted" in said.splitlines()[-1]


@pytest.mark.kills
def test_nodes_do_not_outlive_a_killed_starter(ros_domain: int, tmp_path: Path) -> None:
    script = tmp_path / "start.py"
    script.write_text(
        "import time; from graph.test_runner import graph, tiny\n"
        "from wm_nodes.launching.runner import Runner\n"
        "with Runner(graph(tiny('a'), tiny('b')), log=None) as runner:\n"
        "    runner.wait_ready(30); print(runner.process('a').pid, flush=True); time.sleep(60)\n"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])}
    process = subprocess.Popen([sys.executable, str(script)], env=env, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    pid = int(process.stdout.readline())
    process.kill()
    process.wait()
    deadline = time.monotonic() + 10
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(pid)


def test_big_shared_memory_segment_of_the_profile_is_in_use(ros_domain: int) -> None:
    with Runner(graph(tiny("a")), log=None) as runner:
        runner.wait_ready(30)
        mapped = Path(f"/proc/{runner.process('a').pid}/maps").read_text()
        sizes = []
        for line in mapped.splitlines():
            if "/dev/shm/fastrtps_" in line:
                low, high = (int(part, 16) for part in line.split()[0].split("-"))
                sizes.append(high - low)
    assert sizes and max(sizes) >= 32 * 2**20
