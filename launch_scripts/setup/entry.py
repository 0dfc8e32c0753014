"""Set up everything that the entry points of this folder need, once; later starts only compare a stamp.

    python3 launch_scripts/setup            # set up what is missing, then say what is there
    python3 launch_scripts/setup --check    # only say what is missing; exit code 1 if anything is

An entry point calls `ensure()` first: it returns inside the virtual environment's Python, starting the same
script again there if need be. $WM_VENV names another virtual environment than <repository>/.venv.
"""

import argparse
import fcntl
import os
import signal
import sys
from contextlib import contextmanager
from pathlib import Path

from setup import interpreter, place
from setup.console import SetupError, isolated_environment, say
from setup.stamp import fingerprint, finish, python_version, read_stamp, stamp_file, write_stamp

ROOT = Path(__file__).resolve().parents[2]
REQUIREMENTS = ROOT / "requirements"
MESSAGES = ROOT / "msgs_schema"
PACKAGE = ROOT / "wm_nodes"
WORKSPACE = ROOT / "ros2_ws"
SOURCES = "wm_setup_sources.json"
"""File beside the built messages, which comes along in a copy: the fingerprint of the contents that they were built
from, and the folders that they name."""
HELP = ("-h", "--help")
MISSING = ":missing"
"""Suffix of the renderer's stamp where this user may not install system packages."""


def venv_folder():
    """The virtual environment: $WM_VENV, else <repository>/.venv."""
    return Path(os.environ.get("WM_VENV") or ROOT / ".venv").expanduser().absolute()


def ensure(argv=None):
    """Return when the running Python is the virtual environment's and holds all that is needed; else make it so.

    Ends the process with one message when that is impossible. Where the arguments ask for help, nothing is set up, and
    what the standard library can import of wm_nodes is found in this checkout.
    """
    if {*HELP} & {*(sys.argv[1:] if argv is None else argv)}:
        sys.path.insert(0, str(PACKAGE))
        return
    if not interpreter.supported(sys.version_info):
        other = interpreter.find_supported()
        if other is None:
            raise SystemExit("error: " + interpreter.unsupported_message(sys.version_info))
        say(f"this is Python {sys.version_info[0]}.{sys.version_info[1]}; continuing with {other}")
        os.execv(other, [other, *sys.argv])
    venv = venv_folder()
    with _one_line():
        place.refuse_links(ROOT, (venv, WORKSPACE, *(WORKSPACE / name for name in ("build", "install"))))
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # a Ctrl-C of meanwhile counts from here on
        if pending(venv):
            with _alone(venv):
                _set_up(venv)
        elif read_stamp(stamp_file(venv)).get("renderer", "").endswith(MISSING):
            _recheck_renderer(venv)
    if Path(sys.prefix).resolve() != venv.resolve():
        python = str(venv / "bin" / "python")
        sys.stdout.flush()
        sys.stderr.flush()
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # it would be a traceback while Python starts
        os.execve(python, [python, *sys.orig_argv[1:]], isolated_environment(venv))


def launch(scenario):
    """Start the graph of a launch file, or show its arguments, for which nothing is set up. Return the exit code."""
    if {*HELP, "-s", "--show-args"} & {*sys.argv[1:]}:
        ensure(HELP)
        from wm_nodes.launching.scenarios import describe_arguments

        print(describe_arguments(scenario))
        return 0
    ensure()
    with interruptible():
        from wm_nodes.launching.start import start
    return start(scenario)


@contextmanager
def interruptible(text="interrupted"):
    """End the process with one line at Ctrl-C."""
    try:
        yield
    except KeyboardInterrupt:
        print(text, file=sys.stderr)
        raise SystemExit(130) from None


def pending(venv):
    """Return the steps that are to be done, in order: place, packages, messages, wm_nodes, renderer."""
    from setup.messages import lacks_tf

    stamp, wanted = read_stamp(stamp_file(venv)), _wanted(venv)
    present = {
        "packages": (venv / "bin" / "python").exists(),
        "messages": built_messages().get("messages") == wanted["messages"] and not lacks_tf(venv),
    }
    done = {step: stamp.get(step, "").split(":")[0] for step in wanted}
    return [step for step in wanted if not present.get(step, True) or done[step] != wanted[step]]


def built_messages():
    """What SOURCES holds; empty where there is no whole build."""
    install = WORKSPACE / "install" / "wm_msgs"
    whole = (install / "share" / "wm_msgs" / "package.xml").exists()
    return read_stamp(install / SOURCES) if whole else {}


def _wanted(venv):
    from setup.messages import message_sources

    packages = fingerprint(REQUIREMENTS.glob("*.txt"), python_version(venv))
    build_files = [PACKAGE / name for name in ("setup.py", "setup.cfg", "pyproject.toml")]
    return {
        "place": fingerprint([], str(ROOT), str(venv)),
        "packages": packages,
        "messages": fingerprint(message_sources(MESSAGES), packages),
        "wm_nodes": fingerprint(build_files, packages),
        "renderer": fingerprint([ROOT / "launch_scripts" / "setup" / "system.py"]),
    }


def _set_up(venv):
    from setup import messages, packages, system

    steps = pending(venv)
    if not steps:
        return
    log, done, before = venv.parent / (venv.name + "_setup.log"), {}, place.former(venv, ROOT)
    if left := [step for step in steps if step != "place"]:
        say(f"setting up {', '.join(left)}; output of the commands is in {log}")
    if "packages" in steps:
        packages.create_venv(venv, log)
    if before and before != place.present(venv, ROOT):
        say(f"this checkout or its environment was in another folder: writing {ROOT} into {venv}")
        place.settle(venv, ROOT, log, before)
    wanted = _wanted(venv)
    copied = "messages" not in read_stamp(stamp_file(venv)) and built_messages().get("messages") == wanted["messages"]
    if copied:  # with the checkout, and not with the environment
        made = built_messages()
        place.settle(venv, ROOT, log, {name: made[name] for name in place.present(venv, ROOT)})
    if "renderer" in steps or "packages" in steps:
        ready = system.install(system.current_plan(), log)
        done["renderer"] = wanted["renderer"] + ("" if ready else MISSING)
    actions = {
        "packages": lambda: packages.install_packages(venv, REQUIREMENTS, log),
        "messages": lambda: messages.build_messages(venv, WORKSPACE, log, built=copied),
        "wm_nodes": lambda: packages.install_editable(venv, PACKAGE, log),
    }
    for step, action in actions.items():
        if step in steps:
            action()
            if step == "messages":
                _note_build(wanted, venv)
            finish(venv, {**done, step: wanted[step]})
    place.settle(venv, ROOT, log)
    _note_build(wanted, venv)
    finish(venv, {**done, "place": wanted["place"], **place.present(venv, ROOT)})
    say("done")


def _note_build(wanted, venv):
    sources = {"messages": wanted["messages"], **place.present(venv, ROOT)}
    write_stamp(WORKSPACE / "install" / "wm_msgs" / SOURCES, sources)


def _recheck_renderer(venv):
    """The last set-up could not install system packages: look whether they have arrived, and say so if not."""
    from setup import system

    plan = system.current_plan()
    if plan.packages:
        say(f"still without {', '.join(plan.packages)}; `python3 launch_scripts/setup --system` says what to do")
        return
    finish(venv, {"renderer": read_stamp(stamp_file(venv))["renderer"].removesuffix(MISSING)})


@contextmanager
def _one_line():
    """End the process with one line where the set-up cannot go on or is interrupted."""
    try:
        with interruptible("interrupted; start again to continue where the set-up stopped"):
            yield
    except SetupError as error:
        raise SystemExit(f"error: {error}") from None
    except OSError as error:
        where = "" if error.filename else f" in {venv_folder().parent}"
        raise SystemExit(f"error: {error}{where}; remedy that, then start again to continue") from None


@contextmanager
def _alone(venv):
    """Hold a lock file, so that two starts at the same time set up once; commands started meanwhile hold it, too.
    SIGTERM then does what Ctrl-C does."""
    venv.parent.mkdir(parents=True, exist_ok=True)
    with open(venv.parent / (venv.name + ".lock"), "w", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say(f"another process is setting up {venv}; waiting for it")
            fcntl.flock(lock, fcntl.LOCK_EX)
        os.set_inheritable(lock.fileno(), True)
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            yield
        finally:
            signal.signal(signal.SIGTERM, before)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="change nothing; exit code 1 when something is missing")
    parser.add_argument("--system", action="store_true", help="only install, or name, missing system packages")
    arguments = parser.parse_args()
    if arguments.check:
        steps = pending(venv_folder())
        print("missing or out of date: " + ", ".join(steps) if steps else "complete")
        return int(bool(steps))
    if arguments.system:
        from setup import system

        with _one_line():
            return int(not system.install(system.current_plan(), ROOT / ".venv_setup.log"))
    ensure()
    import rclpy
    import torch

    import wm_msgs.msg
    from wm_nodes import __version__

    print(f"wm_nodes {__version__} on Python {sys.version.split()[0]}, torch {torch.__version__}")
    print(f"rclpy from {Path(rclpy.__file__).parent}, wm_msgs from {Path(wm_msgs.msg.__file__).parents[1]}")
    print(f"activate: source {venv_folder() / 'bin' / 'activate'}")
    return 0
