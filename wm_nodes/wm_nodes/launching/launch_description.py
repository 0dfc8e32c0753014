"""The launch description of a scenario for `ros2 launch`; needs the ROS 2 packages launch and launch_ros (apt).

ros2 runs under the system's Python, which has neither pydantic nor torch: the graph is made by the nodes' interpreter
(launching.arguments, in a process of its own), and this module imports only the standard library.

PyPI's `launch` 0.1.3 is an unrelated project of the same name.
"""

import json
import subprocess
from collections.abc import Iterable, Mapping
from typing import Any

from wm_nodes.launching.domain_lock import DomainLock
from wm_nodes.launching.environment import graph_environment, interpreter
from wm_nodes.launching.graph import RESPAWN_S, Graph, NodeSpec
from wm_nodes.launching.scenarios import argument_table, is_setting, parse_arguments, run_folder
from wm_nodes.training.run_lock import RunLock

LOCKS: list[DomainLock] = []
"""Of the graphs that this process launched, until it ends: ros2 launch runs nothing of ours at its own end."""


def launch_description(scenario: str) -> Any:
    """Return the launch.LaunchDescription of a scenario.

    Raises:
        ImportError: where ROS 2's launch is missing, or shadowed by the other project of that name.
    """
    import launch

    if not hasattr(launch, "LaunchDescription"):
        raise ImportError(
            f"{getattr(launch, '__file__', 'launch')} is not ROS 2's launch but an unrelated project; "
            f"pip uninstall launch, or start without it: python3 launch_scripts/{scenario}.launch.py"
        )
    from launch.actions import DeclareLaunchArgument, OpaqueFunction

    table = argument_table(scenario)
    declared = [
        DeclareLaunchArgument(
            argument.name, default_value=argument.default, description=argument.help,
            **({"choices": list(argument.choices)} if argument.choices else {}),
        )
        for argument in table
    ]
    given = set[str]()
    note = OpaqueFunction(function=lambda context: given.update(context.launch_configurations))  # before the defaults
    start = OpaqueFunction(function=lambda context: _start(scenario, context, given))
    return launch.LaunchDescription([note, *declared, start])


def _start(scenario: str, context: Any, names: Iterable[str]) -> list[Any]:
    """names: of the arguments and settings that were given; others, of including launch files, may be among them.

    Raises:
        RunFolderInUseError, DomainInUseError: another process writes into the run folder, or works on the domain on
            this host, whichever way it was started.
    """
    from launch.substitutions import LaunchConfiguration

    known = {argument.name for argument in argument_table(scenario)}
    chosen = sorted(name for name in names if name in known or is_setting(name))
    given = {name: LaunchConfiguration(name).perform(context) for name in chosen}
    parse_arguments(scenario, given)
    lock_of_run = RunLock(run_folder(scenario, given), new=not given.get("run_dir"))
    lock_of_run.acquire()  # until this process ends
    python = interpreter(given)
    graph = prepare_graph(scenario, {**given, "run_dir": str(lock_of_run.folder)}, python)
    domain = int(graph_environment(graph.environment, python=python)["ROS_DOMAIN_ID"])
    lock = DomainLock(domain, f"graph {graph.name!r}")
    lock.acquire()
    LOCKS.append(lock)
    return node_actions(graph, python)


def prepare_graph(scenario: str, given: Mapping[str, str], python: str) -> Graph:
    """Run launching.arguments.begin in the nodes' interpreter and return its graph.

    Raises:
        RuntimeError: its last line of error, and what to set where a module is missing.
    """
    command = [python, "-m", "wm_nodes.launching.arguments", scenario]
    done = subprocess.run(
        command, input=json.dumps(dict(given)), env=graph_environment(python=python), capture_output=True, check=False,
        encoding="utf-8", errors="replace",
    )
    if done.returncode:
        text = (done.stderr.strip().splitlines() or ["no output"])[-1].removeprefix("error: ")
        hint = "" if done.returncode == 2 else f"; {python} is not the nodes' Python: set WM_PYTHON, or python:="
        raise RuntimeError(f"{text}{hint}")
    return Graph.from_json(done.stdout)


def node_actions(graph: Graph, python: str) -> list[Any]:
    """One launch_ros Node per NodeSpec; the end of one shuts the launch down, or starts it again."""
    environment = graph_environment(graph.environment, python=python)
    return [_action(node, python, environment) for node in graph.nodes]


def _action(node: NodeSpec, python: str, environment: dict[str, str]) -> Any:
    from launch.actions import Shutdown
    from launch_ros.actions import Node

    files = [node.extra_parameters] if node.extra_parameters else []
    values = [dict(node.parameters)] if node.parameters else []
    named = {} if node.inside else {"name": node.name, "parameters": [*values, *files]}
    by_node = node.parameter_arguments() if node.inside else []
    return Node(
        executable=python, arguments=node.program(), namespace=node.namespace,
        ros_arguments=["--log-level", node.log_level, *by_node], additional_env=environment, output="screen", **named,
        **({"on_exit": Shutdown(reason=f"{node.label} ended")} if node.required and not node.respawn else {}),
        **({"respawn": True, "respawn_delay": RESPAWN_S} if node.respawn else {}),
    )
