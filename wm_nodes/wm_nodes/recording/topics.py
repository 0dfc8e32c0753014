"""The recorded topics: relative name, type and QoS. QoS comes from this table, never from discovery, so that it is
right in the bag even where a publisher was not seen yet. Equal to the table of ros/qos.py (a parity test says so)."""

from dataclasses import dataclass

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)

_UNSET = QosTime(0, 0)


def _qos(*, depth: int = 0, latched: bool = False, lease_s: int = 0) -> Qos:
    """depth 0: keep all."""
    return Qos(
        QosHistory.KEEP_LAST if depth else QosHistory.KEEP_ALL,
        depth,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        _UNSET,
        _UNSET,
        QosLiveliness.AUTOMATIC,
        QosTime(lease_s, 0),
        False,
    )


IMAGE = _qos(depth=32)
KEEP_ALL = _qos()
LATCHED = _qos(depth=1, latched=True)
POLICY = _qos(depth=1, latched=True, lease_s=3)
GOALS = _qos(depth=18, latched=True)
NEWEST = _qos(depth=1)
METRICS = _qos(depth=10)


@dataclass(frozen=True)
class Topic:
    """name: relative to the namespace. sequenced: the message carries (session, seq), so that losses can be counted."""

    name: str
    msgtype: str
    qos: Qos
    sequenced: bool = True


SPEC = Topic("env/spec", "wm_msgs/msg/EnvSpec", LATCHED)
IMAGES = Topic("env/image", "sensor_msgs/msg/Image", IMAGE, sequenced=False)
TRANSITION = Topic("env/transition", "wm_msgs/msg/TransitionBatch", KEEP_ALL)
GOAL = Topic("env/goal", "wm_msgs/msg/TaskGoal", GOALS)
REWARD = Topic("reward", "wm_msgs/msg/RewardBatch", KEEP_ALL)
EPISODE = Topic("episode", "wm_msgs/msg/EpisodeEvent", KEEP_ALL)
ACTION = Topic("action", "wm_msgs/msg/ActionBatch", NEWEST)
POLICY_VERSION = Topic("policy/version", "wm_msgs/msg/PolicyVersion", POLICY)
REWARD_SUMMARY = Topic("reward/summary", "wm_msgs/msg/RewardSummary", METRICS)
LEARNER_METRICS = Topic("learner/metrics", "wm_msgs/msg/LearnerMetrics", METRICS)
RUN_STATE = Topic("run/state", "wm_msgs/msg/RunState", LATCHED, sequenced=False)

ALL_TOPICS = (
    SPEC, IMAGES, TRANSITION, GOAL, REWARD, EPISODE, ACTION, POLICY_VERSION, REWARD_SUMMARY, LEARNER_METRICS, RUN_STATE,
)  # fmt: skip

DEFAULT_NAMESPACE = "/wm"


def absolute(namespace: str, topic: Topic) -> str:
    return f"{namespace.rstrip('/')}/{topic.name}"
