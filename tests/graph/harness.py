"""Real nodes in real processes on an own ROS domain, and a probe node that talks to them."""

import contextlib
import fcntl
import os
import re
import signal
import subprocess
import sys
import threading
import time
import warnings
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, ClassVar

import rclpy
from action_msgs.msg import GoalStatusArray
from deadlines import PATIENCE_S
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from graph.forked import ForkedNode, fork_node
from left_over import remove_left_over
from rclpy.action import ActionClient
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile, qos_profile_action_status_default

from wm_nodes.config.load import dump_config, load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.errors import WireError
from wm_nodes.core.files import write_atomic
from wm_nodes.ros.endpoint_matching import EndpointTable
from wm_nodes.ros.goals import goal_result
from wm_nodes.ros.qos import topic

DOMAINS = range(20, 60)
PORT, FIRST_PORT, PORTS_PER_DOMAIN = "fastrtps_port", 7400, 250
"""Of Fast DDS: names of files in /dev/shm, and the numbers of DDS."""
TOY_FOLDER = Path(__file__).parent
LOST_S = 5.0
"""A killed node is reported as lost after so much silence at most."""
MATCH_S = 0.5
"""A server that has not matched a new client's reader yet loses its answer (rmw_fastrtps 556)."""
IN_MIDDLEWARE = re.compile(r"Garbage-collecting\n  File \".*/ros/spin\.py\", line \d+ in run_nodes\n")
"""The stack of a node that has stopped, and whose participant does not come back from its destructor: Fast DDS can
deadlock where all leave at once (https://github.com/eProsima/Fast-DDS/issues/6193). Seen once so far;
ros.runner kills such a node after 10 s."""
MATCHED_S = 30.0
"""A restarted node that nobody has matched after this time, and whose shared memory is gone, stays deaf."""
RESEND_S = 8.0
"""A request without an answer is sent once more after this time, for the same reason."""


@contextlib.contextmanager
def own_domain() -> Iterator[int]:
    """A ROS domain that no other test process holds; the lock ends with the process, however it ends.

    One in whose ports nothing is left in /dev/shm comes first: where a process ended while it held a port's lock, all
    that follow wait for it inside Fast DDS.
    """
    ports = [int(name.removeprefix(PORT)) for name in shm_files() if re.fullmatch(rf"{PORT}\d+", name)]
    for domain in sorted(DOMAINS, key={(port - FIRST_PORT) // PORTS_PER_DOMAIN for port in ports}.__contains__):
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(open(f"/tmp/wm_test_domain_{domain}.lock", "w", encoding="utf-8"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield domain
            return
    raise RuntimeError(f"all domains {DOMAINS} are in use; are test processes left over?")


def wait_until(what: str, ready: Callable[[], Any], timeout_s: float = PATIENCE_S) -> Any:
    """Return the first true value of ready(); fail after timeout_s."""
    deadline = time.monotonic() + timeout_s
    while not (value := ready()):
        assert time.monotonic() < deadline, f"not within {timeout_s:g} s: {what}"
        time.sleep(0.02)
    return value


class Probe:
    """A node of the test process on the graph's domain, spun in a thread."""

    def __init__(self, domain: int, namespace: str = "/wm") -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = rclpy.create_node("probe", namespace=namespace, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.messages: dict[str, list[Any]] = defaultdict(list)
        self.diagnostics: dict[str, DiagnosticStatus] = {}
        self.seen_errors: dict[str, list[str]] = defaultdict(list)
        self._clients: dict[str, Any] = {}
        row = topic("/diagnostics")
        self.node.create_subscription(DiagnosticArray, row.name, self._on_diagnostics, row.qos)
        self._stopped = False
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    def listen(self, name: str, at: str | None = None) -> list[Any]:
        """Collect the messages of a topic of the QoS table."""
        row = topic(name)
        self.node.create_subscription(row.type, at or name, self.messages[name].append, row.qos)
        return self.messages[name]

    def feedback(self, kind: type[Any], action: str) -> list[Any]:
        """Collect the Feedback messages of an action's goals. A client's callback gets those only that come before the
        result: rclpy drops what arrives with it or after it, and the last of a burst often does."""
        told = list[Any]()
        self.node.create_subscription(
            kind.Impl.FeedbackMessage, f"{action}/_action/feedback", lambda message: told.append(message.feedback),
            QoSProfile(depth=100),
        )
        time.sleep(MATCH_S)
        return told

    def wait_for_loss(self, reporter: str, lost: str, limit_s: float = LOST_S) -> None:
        """Wait for a node's report that it lost another; the silence that it names is `limit_s` at most."""
        said = wait_until(f"a report of {reporter} that {lost} is lost", lambda: self.losses(reporter, lost))[0]
        assert said <= limit_s, f"{reporter} called {lost} lost after {said:g} s of silence"

    def losses(self, reporter: str, lost: str) -> list[float]:
        """Seconds of silence in each report of a node that it lost another."""
        reported = re.compile(rf"{lost} is lost: silent for ([\d.]+) s")
        return [float(seconds[1]) for text in self.seen_errors[reporter] for seconds in reported.finditer(text)]

    def goals(self, action: str) -> dict[bytes, int]:
        """State of each goal of an action, a constant of GoalStatus, in the order in which they came."""
        known = dict[bytes, int]()

        def hear(message: GoalStatusArray) -> None:
            known.update({bytes(each.goal_info.goal_id.uuid): each.status for each in message.status_list})

        self.node.create_subscription(
            GoalStatusArray, f"{action}/_action/status", hear, qos_profile_action_status_default
        )
        return known

    def links(self) -> EndpointTable:
        """A book of what the nodes say of their links from now on; a node restarted before it was reported as lost is
        in use again only when the others have matched its new session."""
        book, row = EndpointTable(self.node.get_fully_qualified_name()), topic("run/links")

        def hear(message: Any) -> None:
            with contextlib.suppress(WireError):
                book.note(message)

        self.node.create_subscription(row.type, row.name, hear, row.reader_qos)
        return book

    def publisher(self, name: str) -> Any:
        row = topic(name)
        return self.node.create_publisher(row.type, name, row.qos)

    def call(self, kind: type[Any], name: str, request: Any, timeout_s: float = PATIENCE_S) -> Any:
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
            wait_until(f"service {name}", self._clients[name].service_is_ready)
            time.sleep(MATCH_S)
        client = self._clients[name]
        wait_until(f"service {name}", client.service_is_ready)
        if timeout_s <= RESEND_S:
            return self.result(client.call_async(request), timeout_s, name)
        sent = [client.call_async(request)]
        answered = threading.Event()
        sent[0].add_done_callback(lambda _: answered.set())
        if not answered.wait(RESEND_S):
            sent.append(client.call_async(request))
            sent[1].add_done_callback(lambda _: answered.set())
            assert answered.wait(timeout_s - RESEND_S), f"{name}: no answer within {timeout_s:g} s"
        return next(future for future in sent if future.done()).result()

    def action(self, kind: type[Any], name: str) -> ActionClient:
        if name not in self._clients:
            self._clients[name] = ActionClient(self.node, kind, name)
            wait_until(f"action {name}", self._clients[name].server_is_ready)
            time.sleep(MATCH_S)
        wait_until(f"action {name}", self._clients[name].server_is_ready)
        return self._clients[name]

    def send(self, client: ActionClient, goal: Any, feedback: Any = None) -> Any:
        """Send a goal and return its accepted handle."""
        handle = self.run(lambda: client.send_goal_async(goal, feedback_callback=feedback), PATIENCE_S, "goal")
        assert handle.accepted
        return handle

    def finish(self, handle: Any, timeout_s: float = PATIENCE_S) -> Any:
        """Wait for a goal's result; return the Result message."""
        return goal_result(handle, timeout_s, lambda: None)

    def cancel(self, handle: Any) -> Any:
        """Cancel a goal; return the Result message."""
        self.run(handle.cancel_goal_async, PATIENCE_S, "cancel")
        return self.finish(handle)

    def run(self, send: Callable[[], Any], timeout_s: float, what: str) -> Any:
        """Call `send` in the executor's thread (rclpy's action client races with it otherwise) and wait."""
        return self.result(self.result(self._executor.create_task(send), timeout_s, what), timeout_s, what)

    def result(self, future: Any, timeout_s: float, what: str) -> Any:
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        assert done.wait(timeout_s), f"{what}: no answer within {timeout_s:g} s"
        return future.result()

    def value(self, node: str, key: str) -> str | None:
        """A diagnostics value of a node, e.g. value("/wm/environment", "step_id")."""
        status = self.diagnostics.get(node)
        return None if status is None else next((v.value for v in status.values if v.key == key), None)

    def close(self) -> None:
        self._stopped = True
        self._thread.join()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = status.name.split(":")[0]
            self.diagnostics[name] = status
            if status.level == DiagnosticStatus.ERROR:
                self.seen_errors[name].append(status.message)

    def _spin(self) -> None:
        with contextlib.suppress(ExternalShutdownException):
            while not self._stopped:
                self._executor.spin_once(timeout_sec=0.05)


class Graph:
    """Processes of one run folder on one domain. forks: see graph.forked; otherwise each node is an interpreter of its
    own, with its own hash seed."""

    started: ClassVar[list["Graph"]] = []
    """Of the running test, or running still; conftest prints the logs of a failed one."""

    def __init__(self, domain: int, folder: Path, config: RunConfig | None = None, *, forks: bool = True) -> None:
        self.domain, self.folder = domain, folder
        self._launcher: tuple[str, ...] | None = None if forks else ()
        folder.mkdir(parents=True, exist_ok=True)
        self.config = config or load_config("smoke")
        (folder / "config.yaml").write_text(dump_config(self.config), encoding="utf-8")
        self.processes: dict[str, subprocess.Popen[bytes] | ForkedNode] = {}
        self._logs: list[IO[bytes]] = []
        Graph.started.append(self)

    def start(
        self, node: str, namespace: str = "/wm", launcher: tuple[str, ...] | None = None, **params: Any
    ) -> subprocess.Popen[bytes] | ForkedNode:
        """Fork wm_nodes.nodes.<node>_node, or start python LAUNCHER -m ...; a parameter is given by keyword, a
        setting as section__key."""
        settings = {name: params.pop(name) for name in [*params] if "__" in name}
        values = {"config_file": self.config_file(**settings), "run_dir": self.folder, **params}
        module, args = f"wm_nodes.nodes.{node}_node", ["--ros-args", "-r", f"__ns:={namespace}"]
        for name, value in values.items():
            args += ["-p", f"{name}:={str(value).lower() if isinstance(value, bool) else value}"]
        name = f"{namespace}/{node}"
        launcher = self._launcher if launcher is None else launcher
        if launcher is None:
            self.processes[name] = fork_node([module, *args], self.environment(), self.log_path(name))
            return self.processes[name]
        log = open(self.log_path(name), "ab")  # noqa: SIM115
        self._logs.append(log)
        command = [sys.executable, *launcher, "-m", module, *args]
        self.processes[name] = subprocess.Popen(command, env=self.environment(), stdout=log, stderr=subprocess.STDOUT)
        return self.processes[name]

    def config_file(self, **settings: Any) -> Path:
        """The run's configuration, or beside it one with changes, as section__key."""
        run = self.folder / "config.yaml"
        if not settings:
            return run
        text = dump_config(load_config(str(run), {name.replace("__", "."): value for name, value in settings.items()}))
        path = self.folder / f"config_{zlib.crc32(text.encode()):08x}.yaml"
        write_atomic(path, text.encode())  # a node that was started before may read it now
        return path

    def environment(self) -> dict[str, str]:
        path = os.pathsep.join([str(TOY_FOLDER), str(TOY_FOLDER.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
        return {
            **os.environ, "PYTHONPATH": path, "ROS_DOMAIN_ID": str(self.domain), "OMP_NUM_THREADS": "1",
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOG_DIR": str(self.folder / "ros_log"),
        }

    def start_environment(self, factory: str = "toy:make_environment", num_envs: int = 4, **params: Any) -> Any:
        named = {"backend": "environment", "environment__factory": factory, "num_envs": num_envs}
        return self.start("environment", **named, **params)

    def start_policy(self, **params: Any) -> Any:
        return self.start("policy", policy__factory="toy:make_policy", **params)

    def start_reward(self, **params: Any) -> Any:
        return self.start("reward_evaluator", reward="rule", **params)

    def start_learner(self, **params: Any) -> Any:
        return self.start("learner", policy__factory="toy:make_policy", **params)

    def start_training_nodes(self, **learner: Any) -> None:
        """environment, policy, reward_evaluator and learner, as in a training run."""
        self.start_environment()
        recorder = [name.rpartition("/")[2] for name in self.processes if name == "/wm/recorder"]
        self.start_policy(await_nodes=["environment", "reward_evaluator", "learner", *recorder])
        self.start_reward()
        self.start_learner(**learner)

    @property
    def running(self) -> bool:
        return any(process.poll() is None for process in self.processes.values())

    def log_path(self, name: str) -> Path:
        return self.folder / f"{name.strip('/').replace('/', '_')}.log"

    def log(self, name: str) -> str:
        return self.log_path(name).read_text(encoding="utf-8")

    def kill(self, name: str) -> None:
        """kill -9 and reap."""
        self.processes[name].kill()
        self.processes[name].wait(10)

    def restart(self, start: Callable[[], Any], book: EndpointTable, *names: str, process: str = "") -> None:
        """Start the killed node names[0] again; return when it and the other names have matched each other.

        A new process may stay deaf under load (4 of some 400 kills on two busy cores): Fast DDS 2.14 gives it the port
        of the killed one, and a process that was still sending to that port removes its shared memory, by its name
        (compare https://github.com/eProsima/Fast-DDS/issues/5053). A user would start it again, and so does this, with
        a warning; only where the memory is gone, so that no fault of ours is taken for that one.

        Args:
            book: what the probe knows of the links.
            process: its key in `processes`, where that is not its name.
        """
        process = process or names[0]
        with contextlib.ExitStack() as held:
            for last in (False, False, True):
                book.forget(names[0], lost=True)
                start()
                pid, began_s, removed = self.processes[process].pid, time.monotonic(), list[str]()
                while (lacking := book.missing(names)) and not removed:
                    time.sleep(0.1)
                    waited_s = time.monotonic() - began_s
                    removed = removed_ports(pid) if waited_s > MATCHED_S else []
                    text = f"{'; '.join(lacking)} after {waited_s:.0f} s; removed shared memory: {removed}"
                    assert waited_s < PATIENCE_S and not (last and removed), text
                if not lacking:
                    time.sleep(MATCH_S)  # for the probe's clients
                    return
                warnings.warn(f"{names[0]} started once more: {text}", stacklevel=2)
                self.kill(process)
                for port in removed:  # one whose lock is held is passed over
                    lock = held.enter_context(open(f"/dev/shm/{port}_el", "ab"))
                    with contextlib.suppress(OSError):
                        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def stop(self) -> dict[str, int]:
        """SIGINT all; after 20 s SIGABRT, which leaves the stack in the log. Return the exit codes; 0, with a warning,
        for a node that had done all of its own and hung in the middleware's destructors."""
        for process in self.processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        codes = {}
        for name, process in self.processes.items():
            try:
                codes[name] = process.wait(20)
            except subprocess.TimeoutExpired:
                threads = thread_names(process.pid)
                process.send_signal(signal.SIGABRT)
                codes[name] = process.wait(5)
                remove_left_over()
                if IN_MIDDLEWARE.search(self.log(name)):
                    codes[name] = 0
                    warnings.warn(f"{name} hung in the middleware's destructors; threads: {threads}", stacklevel=2)
        for log in self._logs:
            log.close()
        return codes


def thread_names(pid: int) -> list[str]:
    """Of a process, as the system knows them: Fast DDS names its threads by what they serve."""
    return [path.read_text(encoding="utf-8").strip() for path in Path(f"/proc/{pid}/task").glob("*/comm")]


def removed_ports(pid: int) -> list[str]:
    """Ports of Fast DDS that a process still has in its memory, and whose files are gone."""
    return re.findall(r"/dev/shm/(fastrtps_port\d+) \(deleted\)", Path(f"/proc/{pid}/maps").read_text(encoding="utf-8"))


def shm_files() -> set[str]:
    """Shared-memory files of Fast DDS on this host."""
    return {name for name in os.listdir("/dev/shm") if "fastrtps" in name or "fastdds" in name}
