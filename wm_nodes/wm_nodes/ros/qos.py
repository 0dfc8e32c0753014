"""The graph's topics: one row each, with message class and QoS. Profiles of recorded topics are those of
recording/topics.py; here are only what nobody records, and the profiles of viewers."""

import re
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Bool

from wm_msgs.msg import (
    ActionBatch,
    ClipBatch,
    ClipScores,
    ClipVerdict,
    Credit,
    EnvSpec,
    EpisodeEvent,
    LearnerMetrics,
    NodeLinks,
    PolicyVersion,
    RewardBatch,
    RewardSummary,
    RunState,
    TaskGoal,
    TransitionBatch,
)
from wm_nodes.recording import topics as recorded

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # ROS 2 from apt has it, and the set-up builds it; other environments may lack it
    TFMessage = None

WRITTEN_BY_EVERY_NODE = ("run/state", "run/links")
EVERY_NODE_DEPTH = 64
"""More nodes than a graph has, so that a reader that was busy finds the newest word of each."""


@dataclass(frozen=True)
class GraphTopic:
    """One row of the table."""

    name: str
    """Relative, below the graph's namespace, unless it starts with '/'."""
    type: type[Any]
    """Message class."""
    qos: QoSProfile
    """Of publishers."""

    @property
    def reader_qos(self) -> QoSProfile:
        """The profile of subscriptions. On a topic without keys a reader's KEEP_LAST depth counts over all writers:
        where every node writes, depth 1 would leave a reader that was busy with one node's message."""
        if self.name not in WRITTEN_BY_EVERY_NODE:
            return self.qos
        profile = copy(self.qos)
        profile.depth = EVERY_NODE_DEPTH
        return profile


def profile_of(qos: Qos) -> QoSProfile:
    """The rclpy profile of a row of recording/topics.py."""
    return QoSProfile(
        reliability=ReliabilityPolicy[qos.reliability.name], durability=DurabilityPolicy[qos.durability.name],
        history=HistoryPolicy[qos.history.name], depth=qos.depth, liveliness=LivelinessPolicy[qos.liveliness.name],
    )


def _graph_topic(topic: recorded.RecordedTopic, message: type[Any]) -> GraphTopic:
    return GraphTopic(topic.name, message, profile_of(topic.qos))


LATCHED = profile_of(recorded.LATCHED)
METRICS = profile_of(recorded.METRICS)

VIEW = QoSProfile(reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST, depth=1)
"""For viewers: never holds anything back, and as a reader no publisher's QoS keeps it out."""

PICTURE = QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=2)
"""For viewers that ask for reliable images, as RViz does unless told otherwise; it holds nothing back either."""

CALIBRATION = QoSProfile(
    reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=PICTURE.depth,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""Latched, and as deep as the pictures that it comes with."""

FRAMES = QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=100)
"""As tf2_ros publishes /tf; /tf_static is LATCHED, as there."""

CLOCK = QoSProfile(reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST, depth=1)
CREDIT = METRICS
"""Deeper than one: several consumers publish on the same topic."""

ACTION_LIFESPAN_S = 1.0
LIVE_ACTION = QoSProfile(
    reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=1,
    lifespan=Duration(seconds=ACTION_LIFESPAN_S),
)
"""Actions that are carried out when they arrive (asynchronous mode): a stale one is worthless and is not delivered."""

TOPICS: dict[str, GraphTopic] = {
    topic.name: topic
    for topic in (
        _graph_topic(recorded.IMAGES, Image),
        _graph_topic(recorded.TRANSITION, TransitionBatch),
        _graph_topic(recorded.SPEC, EnvSpec),
        _graph_topic(recorded.GOAL, TaskGoal),
        _graph_topic(recorded.REWARD, RewardBatch),
        _graph_topic(recorded.REWARD_SUMMARY, RewardSummary),
        _graph_topic(recorded.EPISODE, EpisodeEvent),
        _graph_topic(recorded.ACTION, ActionBatch),
        _graph_topic(recorded.POLICY_VERSION, PolicyVersion),
        _graph_topic(recorded.LEARNER_METRICS, LearnerMetrics),
        _graph_topic(recorded.RUN_STATE, RunState),
        _graph_topic(recorded.CLIPS, ClipBatch),
        _graph_topic(recorded.CLIP_IMAGES, Image),
        _graph_topic(recorded.CLIP_SCORES, ClipScores),
        _graph_topic(recorded.VIDEO_VERSION, PolicyVersion),
        _graph_topic(recorded.VERDICT, ClipVerdict),
        GraphTopic("env/image/compressed", CompressedImage, PICTURE),
        GraphTopic("env/camera/<name>/image_raw", Image, PICTURE),
        GraphTopic("env/camera/<name>/camera_info", CameraInfo, CALIBRATION),
        GraphTopic("env/camera/<name>/transform", TransformStamped, LATCHED),
        GraphTopic("flow/credit", Credit, CREDIT),
        GraphTopic("run/links", NodeLinks, LATCHED),
        GraphTopic("safety/estop", Bool, LATCHED),
        GraphTopic("/diagnostics", DiagnosticArray, METRICS),
        GraphTopic("/clock", Clock, CLOCK),
    )
}
if TFMessage is not None:
    TOPICS |= {name: GraphTopic(name, TFMessage, qos) for name, qos in (("/tf", FRAMES), ("/tf_static", LATCHED))}
"""A topic of each camera has <name> in place of the camera's name."""


def row_name(name: str) -> str:
    """A topic's name as TOPICS has it."""
    return re.sub(r"\benv/camera/\w+/", "env/camera/<name>/", name)


def topic(name: str) -> GraphTopic:
    """Return the row of a topic by its relative name.

    Raises:
        KeyError: names the topics that exist.
    """
    if row_name(name) not in TOPICS:
        raise KeyError(f"unknown topic {name!r}; the table in wm_nodes/ros/qos.py has {', '.join(sorted(TOPICS))}")
    return replace(TOPICS[row_name(name)], name=name)
