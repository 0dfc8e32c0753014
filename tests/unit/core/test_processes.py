"""What real processes are seen to do."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from wm_nodes.core.processes import Activity, ActivityWatch


@contextmanager
def process(code: str) -> Iterator[subprocess.Popen[bytes]]:
    child = subprocess.Popen([sys.executable, "-c", f"print(1, flush=True)\n{code}"], stdout=subprocess.PIPE)
    assert child.stdout is not None
    child.stdout.readline()
    try:
        yield child
    finally:
        child.kill()
        child.wait()
        child.stdout.close()


def looks(pid: int, number: int = 2) -> Activity:
    watch = ActivityWatch()
    for _ in range(number - 1):
        watch.look(pid)
        time.sleep(0.3)
    return watch.look(pid)


def test_a_process_that_waits_does_nothing_and_one_look_gives_it_the_benefit_of_the_doubt() -> None:
    with process("import time; time.sleep(60)") as child:
        assert looks(child.pid, 1) is Activity.BUSY
        assert looks(child.pid, 2) is Activity.IDLE


def test_a_process_whose_other_thread_computes_is_busy() -> None:
    code = "import threading, hashlib\nt = threading.Thread(target=lambda: [hashlib.sha256(bytes(10**7)) for _ in "
    with process(f"{code}range(10**6)])\nt.start()\nt.join()") as child:
        assert looks(child.pid, 3) is Activity.BUSY


def test_a_stopped_process_and_one_that_ended_are_told_apart() -> None:
    with process("import time; time.sleep(60)") as child:
        child.send_signal(signal.SIGSTOP)
        time.sleep(0.1)
        assert looks(child.pid) is Activity.STOPPED
        child.kill()
        time.sleep(0.1)
        assert looks(child.pid) is Activity.GONE, "not reaped yet"
        child.wait()
        assert looks(child.pid) is Activity.GONE
