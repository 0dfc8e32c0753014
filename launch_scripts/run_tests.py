"""Every check of the repository: ruff, mypy, import contracts, then the tests. Sets up what is missing first, on Debian
with a browser, which only the tests of pages need.

python3 launch_scripts/run_tests.py            # everything
python3 launch_scripts/run_tests.py --fast     # without the tests marked slow or alone
python3 launch_scripts/run_tests.py tests/unit -k setup    # other arguments go to pytest; the checks still run
python3 launch_scripts/run_tests.py --device cuda          # only the tests of a CUDA device, on the GPU that is here

Tests run three at a time, since graphs wait more than they compute, and those with deadlines after the others.
A graph test that fails so, or that hangs inside DDS, is run once more by itself, which the output says: deadlines are
promised where nothing else keeps the machine busy.
"""

import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from setup import system
from setup.entry import ensure, interruptible

ROOT = Path(__file__).resolve().parents[1]
FAILED, CRASHED = (Path(".pytest_cache/v") / name for name in ("cache/lastfailed", "wm/crashed"))
MOST_AGAIN = 8
"""More failed tests than this are no accident: neither of their neighbours, nor of a process that hung inside DDS."""
MOST_CRASHES = 2
"""After more ended processes pytest-xdist stops, and tests are left out."""
BY_FILE = ("-n3", "--dist", "loadfile", "--no-loadscope-reorder", f"--max-worker-restart={MOST_CRASHES}")
LONG_FIRST = ("tests/graph", "tests/parity", "tests/unit", "tests/contracts")
WITH_DEADLINES = ("tests/graph",)  # tests/conftest.py sees to it that there are no others
CHECKS = {
    "ruff": ("ruff", "check", "."), "mypy --strict": ("mypy",), "import contracts": ("lint-imports", "--no-cache"),
}


def main(argv):
    """Run the checks, and pytest beside them where it runs every test. Return 0 if all passed."""
    named = [text for text in argv if text != "--fast"]
    fast = ["not slow"] if "--fast" in argv else []
    if any(text.split("=")[0] == "--device" for text in named):
        return _pytest(["-m", " and ".join(["device", *fast]), *named])
    system.install(system.browser_plan(system.find_browser(), system.read_os_release()), ROOT / ".venv_setup.log")
    with ThreadPoolExecutor() as beside:
        passed = beside.map(_passes, CHECKS)
        if named:
            passed = list(passed)
        code = _pytest(["-m", " and ".join(fast), *named]) if named else _every_test(fast)
        failed = [name for name, well in zip(CHECKS, passed) if not well]
    if failed:
        print(f"failed beside the tests: {', '.join(failed)}", flush=True)
    return code or int(bool(failed))


def _every_test(fast):
    """Run the tests without deadlines, then, unless `fast`, those with them, and once more what failed."""
    forget()
    codes = [_pytest(["-m", " and ".join(["not alone", *fast]), *BY_FILE, *LONG_FIRST])]
    if not fast:
        codes.append(_pytest(["-m", "alone", *BY_FILE, *WITH_DEADLINES]))
    return repeated() if max(codes) == 1 else max(codes)


def forget():
    """Forget what failed before. pytest's --cache-clear would do so again in each process that replaces another."""
    for file in (FAILED, CRASHED):
        (ROOT / file).unlink(missing_ok=True)


def repeated():
    """Run the tests that failed once more, without neighbours, if all are of graphs and few. Return pytest's code."""
    files = (ROOT / FAILED, ROOT / CRASHED)
    failed, crashed = (list(json.loads(file.read_text(encoding="utf-8"))) if file.exists() else [] for file in files)
    tests = sorted({*failed, *crashed})
    few = len(tests) <= MOST_AGAIN and len(crashed) <= MOST_CRASHES
    if not tests or not few or not all(test.startswith("tests/graph/") for test in tests):
        return 1
    print("\nonce more, by themselves:", *tests, sep="\n  ", flush=True)
    return _pytest(tests)


def _pytest(arguments):
    return subprocess.run(
        [sys.executable, "-m", "pytest", "--durations=12", *arguments], cwd=ROOT, check=False, env=_environment()
    ).returncode


def _passes(name):
    """Whether one of CHECKS finds nothing; what it says is printed once it has ended."""
    start, (program, *arguments) = time.monotonic(), CHECKS[name]
    done = subprocess.run(
        [str(Path(sys.prefix) / "bin" / program), *arguments], cwd=ROOT, capture_output=True, encoding="utf-8",
        errors="replace", check=False, env=_environment(),
    )
    print(f"{name}: {'passed' if done.returncode == 0 else 'FAILED'} ({time.monotonic() - start:.0f} s)", flush=True)
    if done.returncode:
        print(done.stdout + done.stderr, flush=True)
    return done.returncode == 0


def _environment():
    """This host only, no repeated tests, one thread per process unless told otherwise; tests pick the ROS domain.

    Compiled modules are kept, whatever the user's shell says: some hundred processes import torch, which takes one that
    compiles it anew three times as long.
    """
    env = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    env.setdefault("OMP_NUM_THREADS", "1")
    for name in ("WM_TEST_RERUNS", "PYTHONDONTWRITEBYTECODE"):
        env.pop(name, None)
    return env


if __name__ == "__main__":
    if {"-h", "--help"} & {*sys.argv[1:]}:
        raise SystemExit(print(__doc__.rstrip()))
    ensure()
    with interruptible():
        raise SystemExit(main(sys.argv[1:]))
