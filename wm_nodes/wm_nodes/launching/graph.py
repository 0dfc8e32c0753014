"""Processes and their nodes as plain data: no rclpy, no launch, no files read."""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

ParameterValue = bool | int | float | str | list[str]
COMPOSABLE = ("environment", "policy", "reward_evaluator", "learner", "recorder", "evaluation")
"""Nodes that wm_nodes.nodes.compose can carry."""
RESPAWN_S = 2.0
"""From the end of a node that is started again to its start."""


class GraphError(ValueError):
    """An argument or scenario that does not exist, or a value that is not allowed."""


@dataclass(frozen=True)
class NodeSpec:
    """One node, whose end ends the graph where it is required."""

    module: str
    """That `python -m` starts."""
    name: str
    """Of the node, without its namespace."""
    namespace: str = "/wm"
    """Absolute."""
    parameters: Mapping[str, ParameterValue] = field(default_factory=dict)
    """ROS parameters, by name."""
    respawn: bool = False
    """It is started again instead."""
    required: bool = True
    """Whether the graph ends with it and waits for it; false: for people who look on."""
    lifecycle: bool = True
    """Ready when active; false: when visible."""
    ranks: int = 1
    """Processes under torchrun; rank 0 is the node."""
    log_level: str = "info"
    """Least severity that it logs."""
    arguments: tuple[str, ...] = ()
    """Of its command line, before those of ROS."""
    inside: tuple["NodeSpec", ...] = ()
    """The nodes that a composed process carries."""
    parameter_file: str = ""
    """Where the starter keeps carried_parameters() of a composed process."""
    extra_parameters: str = ""
    """A parameter file of the user; read last, so it wins."""

    @property
    def full_name(self) -> str:
        return f"{self.namespace.rstrip('/')}/{self.name}"

    @property
    def label(self) -> str:
        """What the starter calls it: the full name without the slash in front."""
        return self.full_name.lstrip("/")

    def program(self) -> list[str]:
        """Arguments of the interpreter, without those of ROS."""
        ranks = ["torch.distributed.run", "--standalone", f"--nproc-per-node={self.ranks}"] if self.ranks > 1 else []
        return ["-m", *ranks, *(["-m"] if ranks else []), self.module, *self.arguments]

    def carried(self) -> tuple["NodeSpec", ...]:
        """The ROS nodes of this process."""
        return self.inside or (self,)

    def ros_arguments(self) -> list[str]:
        """Name, namespace and parameters as rcl reads them. A composed process keeps its nodes' own names."""
        names = [] if self.inside else ["-r", f"__node:={self.name}"]
        log_level = ["--log-level", self.log_level]
        return ["--ros-args", *names, "-r", f"__ns:={self.namespace}", *log_level, *self.parameter_arguments()]

    def parameter_arguments(self) -> list[str]:
        """-p name:=value, or the file of a composed process: `-p node:name:=value` misses nodes in a namespace.

        Values are YAML; JSON quoting keeps text a string.
        """
        more = ["--params-file", self.extra_parameters] if self.extra_parameters else []
        if self.inside:
            return ["--params-file", self.parameter_file, *more]
        given = [part for key, value in self.parameters.items() for part in ("-p", f"{key}:={json.dumps(value)}")]
        return [*given, *more]

    def carried_parameters(self) -> str:
        """The text of parameter_file: JSON, which is YAML."""
        values = {node.full_name: {"ros__parameters": dict(node.parameters)} for node in self.carried()}
        return json.dumps(values, indent=1)


@dataclass(frozen=True)
class Graph:
    """The nodes of one scenario."""

    name: str
    """Of the scenario."""
    nodes: tuple[NodeSpec, ...]
    """The processes to start; a composed one carries several nodes."""
    environment: Mapping[str, str] = field(default_factory=dict)
    """Variables of all nodes."""

    def __post_init__(self) -> None:
        labels = [node.label for node in self.nodes]
        twice = sorted({label for label in labels if labels.count(label) > 1})
        if twice:
            raise GraphError(f"graph {self.name!r} has two nodes called {', '.join(twice)}; give one another namespace")

    def node(self, name: str) -> NodeSpec:
        """The process of a node: by label or, where only one has it, by name; a composed process carries several."""
        matches = [node for node in self.nodes if name.lstrip("/") in [part.label for part in (node, *node.inside)]]
        matches = matches or [node for node in self.nodes if name in [part.name for part in (node, *node.inside)]]
        if len(matches) != 1:
            raise GraphError(
                f"no single node {name!r} in graph {self.name!r}: {', '.join(n.label for n in self.nodes)}"
            )
        return matches[0]

    def to_json(self) -> str:
        return json.dumps(dataclasses.asdict(self), indent=1)

    @classmethod
    def from_json(cls, text: str) -> "Graph":
        """The graph that to_json() wrote."""
        values = json.loads(text)
        return cls(values["name"], tuple(_node_from(node) for node in values["nodes"]), values["environment"])


def _node_from(values: dict[str, Any]) -> NodeSpec:
    inside = tuple(_node_from(node) for node in values["inside"])
    return NodeSpec(**{**values, "inside": inside, "arguments": tuple(values["arguments"])})


def compose(graph: Graph, parameter_file: str) -> Graph:
    """The same graph with the nodes of its namespace in one process, where `wm_nodes.nodes.compose` can carry them.

    Nodes of other namespaces, the player, and a learner of several ranks stay processes of their own.
    """
    namespace = graph.nodes[0].namespace
    inside = [
        node for node in graph.nodes if node.namespace == namespace and node.name in COMPOSABLE and node.ranks == 1
    ]
    if len(inside) < 2:
        return graph
    composed = NodeSpec(
        "wm_nodes.nodes.compose", "composed", namespace, respawn=inside[0].respawn, log_level=inside[0].log_level,
        arguments=tuple(node.name for node in inside), inside=tuple(inside), parameter_file=parameter_file,
        extra_parameters=inside[0].extra_parameters,
    )
    return dataclasses.replace(graph, nodes=(composed, *(node for node in graph.nodes if node not in inside)))
