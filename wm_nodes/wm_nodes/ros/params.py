"""Described parameters: text, unit, range, choices; unknown names and bad values are refused with a reason."""

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterAlreadyDeclaredException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from wm_nodes.core.named_files import NamedFiles

PEER_TIMEOUT_S = 3.0


class ParameterError(ValueError):
    """A parameter that does not exist, or a value outside its range."""


@dataclass(frozen=True)
class Param:
    """One parameter of a node."""

    name: str
    """As on the command line."""
    default: bool | int | float | str | list[str]
    """Its type is the type of the parameter."""
    description: str
    """One plain sentence."""
    unit: str = ""
    """Empty where it has none."""
    read_only: bool = False
    """True where a change would need a new configuration (shapes, files, seeds)."""
    minimum: float | None = None
    """Inclusive; None: no bound."""
    maximum: float | None = None
    """Inclusive; None: no bound."""
    choices: tuple[str, ...] = ()
    """The values that are allowed; empty: all."""

    def descriptor(self) -> ParameterDescriptor:
        described = ParameterDescriptor(
            name=self.name, description=f"{self.description} [{self.unit}]" if self.unit else self.description,
            additional_constraints=f"one of: {', '.join(self.choices)}" if self.choices else "",
            read_only=self.read_only,
        )
        if self.minimum is None and self.maximum is None:
            return described
        if isinstance(self.default, int):
            low = 0 if self.minimum is None else int(self.minimum)
            high = 2**62 if self.maximum is None else int(self.maximum)
            described.integer_range = [IntegerRange(from_value=low, to_value=high, step=0)]
        else:
            low_f = -1e308 if self.minimum is None else float(self.minimum)
            high_f = 1e308 if self.maximum is None else float(self.maximum)
            described.floating_point_range = [FloatingPointRange(from_value=low_f, to_value=high_f, step=0.0)]
        return described

    def problem(self, value: Any) -> str:
        """Return why a value is refused, or ''."""
        if isinstance(value, float) and math.isnan(value):
            return f"{self.name} must be a number; got nan"
        if self.choices and value not in self.choices:
            return f"{self.name} must be one of {', '.join(self.choices)}; got {value!r}"
        for limit, wrong in ((self.minimum, "at least"), (self.maximum, "at most")):
            if limit is None or not isinstance(value, (int, float)):
                continue
            if (wrong == "at least" and value < limit) or (wrong == "at most" and value > limit):
                return f"{self.name} must be {wrong} {limit:g} {self.unit}".rstrip() + f"; got {value!r}"
        return ""


COMMON = (
    Param("config_file", "", "Resolved configuration (YAML), as saved in the run folder", read_only=True),
    Param("run_dir", "", "Run folder: weights, checkpoints and bags go here; its name is the run id", read_only=True),
    Param("allowed_dirs", [""], "Folders, beside run_dir, where others may name files to this node", read_only=True),
    Param("autostart", True, "Configure and activate at start, without a lifecycle manager", read_only=True),
    Param("executor", "events", "Which rclpy executor spins the node", read_only=True,
          choices=("events", "single", "multi")),
    Param("memory_limit_gib", -1.0, "Data that the node's process may hold; 0: no limit; -1: an eighth of the memory "
          "of machine or container, at least 3, and no limit where the node computes on a GPU", "GiB", read_only=True,
          minimum=-1.0, maximum=1e6),
    Param("peer_timeout_s", PEER_TIMEOUT_S, "A node of the graph that is silent for longer is reported as lost", "s",
          minimum=1.0, maximum=60.0),
    Param("service_introspection", "off", "Publish the node's service calls on <service>/_service_event",
          choices=("off", "metadata", "contents")),
)
"""Parameters that every node of the graph has."""


def declare(node: Node, params: Sequence[Param]) -> None:
    """Declare all parameters.

    Raises:
        ParameterError: for a value outside its range or choices, or an override that no parameter has the name of.
    """
    for param in params:
        try:
            node.declare_parameter(param.name, param.default, param.descriptor())
        except ParameterAlreadyDeclaredException:
            continue
        except InvalidParameterTypeException as error:
            kind = type(param.default).__name__
            raise ParameterError(f"{node.get_name()}: parameter {param.name} must be a {kind}; {error}") from None
        except InvalidParameterValueException:
            given = node._parameter_overrides[param.name].value
            raise ParameterError(f"{node.get_name()}: {param.problem(given) or f'{param.name}={given!r}'}") from None
        if problem := param.problem(node.get_parameter(param.name).value):
            raise ParameterError(f"{node.get_name()}: {problem}")
    _refuse_unknown(node)


def named_files(node: Node, *own: str) -> NamedFiles:
    """The files that others may name to a node. own: what the user has named to it, e.g. the bag that it plays."""
    run_dir, allowed = node.get_parameter("run_dir").value, node.get_parameter("allowed_dirs").value
    return NamedFiles(Path(run_dir) if run_dir else None, [name for name in (*allowed, *own) if name])


def refusal(node: Node, params: Mapping[str, Param], changes: Sequence[Parameter]) -> str:
    """Why a change at run time is refused, or ''. params: those of declare(), by name."""
    for change in changes:
        if not node.has_parameter(change.name):
            return _unknown_text(node, change.name)
        param = params.get(change.name)
        if param is None:
            continue
        if param.read_only:
            now = node.get_parameter(param.name).value
            return f"{param.name} stays {now!r} while the node runs; start it again with {param.name}:={change.value}"
        if problem := param.problem(change.value):
            return problem
    return ""


def read_parameters(name: str, params: Sequence[Param]) -> dict[str, Any]:
    """The parameters that a node of this name would have here; for a process that stays off the graph.

    Raises:
        ParameterError: as declare().
    """
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = Node(name, enable_rosout=False)
        declare(node, params)
        values = {param.name: node.get_parameter(param.name).value for param in params}
        node.destroy_node()
        return values
    finally:
        rclpy.shutdown()


def _refuse_unknown(node: Node) -> None:
    """rclpy ignores overrides of undeclared parameters silently; a misspelt name must not start a run."""
    for name in node._parameter_overrides:
        if name.startswith("qos_overrides.") and not node.has_parameter(name):
            raise ParameterError(
                f"{node.get_name()}: parameter {name!r} would change nothing: QoS is one table for graph and bags; "
                "change the topic's row in wm_nodes/recording/topics.py"
            )
        if not node.has_parameter(name):
            raise ParameterError(f"{node.get_name()}: {_unknown_text(node, name)}")


def _unknown_text(node: Node, name: str) -> str:
    known = sorted(declared for declared in node._parameters if "." not in declared)
    close = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"
    return f"unknown parameter {name!r}; {hint}"
