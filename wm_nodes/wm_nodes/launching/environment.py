"""The environment variables in which nodes run. Standard library only."""

import os
import sys
from collections.abc import Mapping
from pathlib import Path

from wm_nodes.ros.middleware import PROFILE, PROFILE_VARIABLE


def interpreter(values: Mapping[str, str]) -> str:
    """The Python that runs the nodes: argument `python`, else $WM_PYTHON, else this one."""
    return values.get("python") or os.environ.get("WM_PYTHON") or sys.executable


def graph_environment(
    extra: Mapping[str, str] | None = None, *, python: str = sys.executable, base: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Return the complete environment of a node's process.

    What the caller's environment already says wins over the defaults, `extra` wins over both. Folders of wm_msgs go in
    front of PYTHONPATH, LD_LIBRARY_PATH and AMENT_PREFIX_PATH, because libraries must be found from the first moment.

    Args:
        extra: variables of the graph, e.g. ROS_DOMAIN_ID.
        python: the interpreter of the node; its virtual environment's libraries are found.
        base: the environment to start from; None: this process's.
    """
    env = dict(os.environ if base is None else base)
    prefix = Path(python).absolute().parent.parent
    if (prefix / "pyvenv.cfg").exists():
        # The guard is set by this process's interpreter; a node of another virtual environment must search anew.
        if prefix.resolve() != Path(sys.prefix).resolve():
            env.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
        _prepend(env, "PATH", prefix / "bin")
        if (prefix / "share" / "ament_index").is_dir():
            _prepend(env, "AMENT_PREFIX_PATH", prefix)
            _prepend(env, "LD_LIBRARY_PATH", prefix / "lib")
        install = (prefix / "share" / "wm_msgs").resolve().parents[1]
        if (install / "share" / "wm_msgs" / "package.xml").is_file():
            _prepend(env, "AMENT_PREFIX_PATH", install)
            _prepend(env, "LD_LIBRARY_PATH", install / "lib")
            for modules in (install / "lib").glob("python3.*/site-packages"):
                _prepend(env, "PYTHONPATH", modules)
    env.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    env.setdefault("ROS_DOMAIN_ID", "0")
    env.setdefault(PROFILE_VARIABLE, str(PROFILE))
    env.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    env.setdefault("PYTHONUNBUFFERED", "1")
    # Nodes take turns on few cores; a second thread that waits for a busy core costs more than it gives.
    env.setdefault("OMP_NUM_THREADS", "1")
    env.setdefault("RCUTILS_COLORIZED_OUTPUT", "0")
    env.update(extra or {})
    return env


def _prepend(env: dict[str, str], name: str, folder: Path) -> None:
    parts = [part for part in env.get(name, "").split(os.pathsep) if part and part != str(folder)]
    env[name] = os.pathsep.join([str(folder), *parts])
