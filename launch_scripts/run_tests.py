"""Every check of the repository: ruff, mypy, import contracts, then the tests. Sets up what is missing first, on Debian
with a browser, which only the tests of pages need.

python3 launch_scripts/run_tests.py            # everything
python3 launch_scripts/run_tests.py --fast     # without the tests marked slow
python3 launch_scripts/run_tests.py tests/unit -k setup    # other arguments go to pytest; the checks still run
python3 launch_scripts/run_tests.py --device cuda          # only the tests of a CUDA device, on the GPU that is here

Tests run two at a time, those with deadlines after the others. A graph test that fails so, or that hangs inside DDS, is
run once more by itself, which the output says: deadlines are promised where nothing else keeps the machine busy.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

from setup import system
from setup.entry import ensure, interruptible

ROOT = Path(__file__).resolve().parents[1]
FAILED, CRASHED = (Path(".pytest_cache/v") / name for name in ("cache/lastfailed", "wm/crashed"))
MOST_AGAIN = 24
"""More failed tests than this are no accident: neither of their neighbours, nor of a process that hung inside DDS."""
MOST_CRASHES = 2
"""After more ended processes pytest-xdist stops, and tests are left out."""
BY_FILE = ("-n", "2", "--dist", "loadfile", "--no-loadscope-reorder", f"--max-worker-restart={MOST_CRASHES}")
LONG_FIRST = ("tests/graph", "tests/parity", "tests/unit", "tests/contracts")
WITH_DEADLINES = ("tests/graph",)  # tests/conftest.py sees to it that there are no others


def main(argv):
    """Run the checks, then pytest, whose closing lines come last. Return 0 if all passed."""
    fast = ["not slow"] if "--fast" in argv else []
    named = [text for text in argv if text != "--fast"]
    if any(text.split("=")[0] == "--device" for text in named):
        return _pytest(["-m", " and ".join(["device", *fast]), *named])
    scripts = Path(sys.prefix) / "bin"
    checks = {
        "ruff": [str(scripts / "ruff"), "check", "."],
        "mypy --strict": [str(scripts / "mypy")],
        "import contracts": [str(scripts / "lint-imports"), "--no-cache"],
    }
    failed = [name for name, command in checks.items() if not _passes(name, command)]
    system.install(system.browser_plan(system.find_browser(), system.read_os_release()), ROOT / ".venv_setup.log")
    if failed:
        print(f"failed before the tests: {', '.join(failed)}", flush=True)
    if named:
        return _pytest(["-m", " and ".join(fast), *named]) or int(bool(failed))
    forget()
    codes = [
        _pytest(["-m", " and ".join(["not alone", *fast]), *BY_FILE, *LONG_FIRST]),
        _pytest(["-m", " and ".join(["alone", *fast]), *BY_FILE, *WITH_DEADLINES]),
    ]
    return (repeated() if max(codes) == 1 else max(codes)) or int(bool(failed))


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


def _passes(name, command):
    start = time.monotonic()
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, encoding="utf-8", errors="replace", check=False, env=_environment()
    )
    print(f"{name}: {'passed' if done.returncode == 0 else 'FAILED'} ({time.monotonic() - start:.0f} s)", flush=True)
    if done.returncode:
        print(done.stdout + done.stderr, flush=True)
    return done.returncode == 0


def _environment():
    """This host only, no repeated tests, one thread per process unless told otherwise; tests pick the ROS domain."""
    env = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    env.setdefault("OMP_NUM_THREADS", "1")
    env.pop("WM_TEST_RERUNS", None)
    return env


if __name__ == "__main__":
    if {"-h", "--help"} & {*sys.argv[1:]}:
        raise SystemExit(print(__doc__.rstrip()))
    ensure()
    with interruptible():
        raise SystemExit(main(sys.argv[1:]))
