"""The QoS table: one profile per stream class, one row per topic."""

from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image
from std_msgs.msg import Bool

from wm_msgs.msg import (
    ActionBatch,
    Credit,
    EnvSpec,
    EpisodeEvent,
    LearnerMetrics,
    PolicyVersion,
    RewardBatch,
    RewardSummary,
    RunState,
    TaskGoal,
    TransitionBatch,
)

CREDIT_WINDOW = 16
"""Messages that a keep-all stream may be ahead of its slowest consumer."""

IMAGE_DEPTH = 2 * CREDIT_WINDOW
"""The images of a full credit window fit into the writer and into the reader twice, so a paced consumer loses none."""

POLICY_LEASE_S = 3.0
"""A policy/version publisher that is silent for longer counts as gone."""


@dataclass(frozen=True)
class Topic:
    """One row of the table. name is relative (below the graph's namespace) unless it starts with '/'."""

    name: str
    type: type[Any]
    qos: QoSProfile


def _profile(reliability: ReliabilityPolicy, durability: DurabilityPolicy, depth: int) -> QoSProfile:
    """depth 0: keep all."""
    history = HistoryPolicy.KEEP_LAST if depth else HistoryPolicy.KEEP_ALL
    return QoSProfile(reliability=reliability, durability=durability, history=history, depth=depth)


_RELIABLE, _BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
_VOLATILE, _LATCHED = DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL

IMAGE = _profile(_RELIABLE, _VOLATILE, IMAGE_DEPTH)
"""A reliable writer matches reliable readers (learner, recorder) and best-effort ones (RViz, rqt)."""

VIEW = _profile(_BEST_EFFORT, _VOLATILE, 1)
"""For viewers: never holds anything back."""

KEEP_ALL = _profile(_RELIABLE, _VOLATILE, 0)
"""Transitions, rewards, episode events. Its queue has no limit: bounded by credit, never by dropping."""

ACTION = _profile(_RELIABLE, _VOLATILE, 1)
LATCHED = _profile(_RELIABLE, _LATCHED, 1)
POLICY = QoSProfile(
    reliability=_RELIABLE, durability=_LATCHED, history=HistoryPolicy.KEEP_LAST, depth=1,
    liveliness=LivelinessPolicy.AUTOMATIC, liveliness_lease_duration=Duration(seconds=POLICY_LEASE_S),
)  # fmt: skip
GOAL = _profile(_RELIABLE, _LATCHED, CREDIT_WINDOW + 2)
"""Latched, but deep: an evaluator that lags by a full credit window still gets the goals of every episode."""

METRICS = _profile(_RELIABLE, _VOLATILE, 10)
CREDIT = _profile(_RELIABLE, _VOLATILE, 10)
"""Deeper than one: several consumers publish on the same topic."""

RUN_STATE = _profile(_RELIABLE, _LATCHED, 1)
CLOCK = _profile(_BEST_EFFORT, _VOLATILE, 1)

TOPICS: dict[str, Topic] = {
    topic.name: topic
    for topic in (
        Topic("env/image", Image, IMAGE),
        Topic("env/transition", TransitionBatch, KEEP_ALL),
        Topic("env/spec", EnvSpec, LATCHED),
        Topic("env/goal", TaskGoal, GOAL),
        Topic("reward", RewardBatch, KEEP_ALL),
        Topic("reward/summary", RewardSummary, METRICS),
        Topic("episode", EpisodeEvent, KEEP_ALL),
        Topic("action", ActionBatch, ACTION),
        Topic("policy/version", PolicyVersion, POLICY),
        Topic("learner/metrics", LearnerMetrics, METRICS),
        Topic("flow/credit", Credit, CREDIT),
        Topic("run/state", RunState, RUN_STATE),
        Topic("safety/estop", Bool, LATCHED),
        Topic("/diagnostics", DiagnosticArray, METRICS),
        Topic("/clock", Clock, CLOCK),
    )
}


def topic(name: str) -> Topic:
    """Return the row of a topic by its relative name.

    Raises:
        KeyError: names the topics that exist.
    """
    if name not in TOPICS:
        raise KeyError(f"unknown topic {name!r}; the table in wm_nodes/ros/qos.py has {', '.join(sorted(TOPICS))}")
    return TOPICS[name]
