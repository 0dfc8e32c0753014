"""The recorded topics: relative name, type and QoS. The graph publishes with these profiles too (ros/qos.py builds on
this table), and a bag's QoS comes from here, never from discovery, so that it is right even where a publisher was not
seen yet."""

from dataclasses import dataclass

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

CREDIT_WINDOW = 16
"""Messages that a keep-all stream may be ahead of its slowest consumer."""

IMAGE_DEPTH = 2 * CREDIT_WINDOW
"""The images of a full credit window fit into the writer and into the reader twice, so a paced consumer loses none."""

_UNSET = QosTime(0, 0)


def _qos(*, depth: int = 0, latched: bool = False) -> Qos:
    """depth 0: keep all."""
    return Qos(
        QosHistory.KEEP_LAST if depth else QosHistory.KEEP_ALL, depth, QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE, _UNSET, _UNSET, QosLiveliness.AUTOMATIC,
        _UNSET, False,
    )


IMAGE = _qos(depth=IMAGE_DEPTH)
"""A reliable writer matches reliable readers (learner, recorder) and best-effort ones (RViz, rqt)."""

KEEP_ALL = _qos()
"""Transitions, rewards, episode events: bounded by credit. Beyond about 10,000 messages that a reader does not take
the middleware refuses further ones, which are counted (ros/publishing.py)."""

LATCHED = _qos(depth=1, latched=True)
GOALS = _qos(depth=CREDIT_WINDOW + 2, latched=True)
"""Latched, but deep: an evaluator that lags by a full credit window still gets the goals of every episode."""

VERDICTS = _qos(depth=512, latched=True)
"""Latched and deep: who joins late sees the last round's verdicts, and a reader loses none of a round of 256 clips."""

NEWEST = _qos(depth=1)
METRICS = _qos(depth=10)


@dataclass(frozen=True)
class RecordedTopic:
    """One row of the table."""

    name: str
    """Relative to the namespace."""
    msgtype: str
    """E.g. wm_msgs/msg/EnvSpec."""
    qos: Qos
    """Of publishers, and in bags."""
    sequenced: bool = True
    """Whether the message carries (session, seq), so that losses can be counted."""


SPEC = RecordedTopic("env/spec", "wm_msgs/msg/EnvSpec", LATCHED)
IMAGES = RecordedTopic("env/image", "sensor_msgs/msg/Image", IMAGE, sequenced=False)
TRANSITION = RecordedTopic("env/transition", "wm_msgs/msg/TransitionBatch", KEEP_ALL)
GOAL = RecordedTopic("env/goal", "wm_msgs/msg/TaskGoal", GOALS)
REWARD = RecordedTopic("reward", "wm_msgs/msg/RewardBatch", KEEP_ALL)
EPISODE = RecordedTopic("episode", "wm_msgs/msg/EpisodeEvent", KEEP_ALL)
ACTION = RecordedTopic("action", "wm_msgs/msg/ActionBatch", NEWEST)
POLICY_VERSION = RecordedTopic("policy/version", "wm_msgs/msg/PolicyVersion", LATCHED)
REWARD_SUMMARY = RecordedTopic("reward/summary", "wm_msgs/msg/RewardSummary", METRICS)
LEARNER_METRICS = RecordedTopic("learner/metrics", "wm_msgs/msg/LearnerMetrics", METRICS)
RUN_STATE = RecordedTopic("run/state", "wm_msgs/msg/RunState", LATCHED, sequenced=False)

ALL_TOPICS = (
    SPEC, IMAGES, TRANSITION, GOAL, REWARD, EPISODE, ACTION, POLICY_VERSION, REWARD_SUMMARY, LEARNER_METRICS, RUN_STATE,
)

CLIPS = RecordedTopic("clips", "wm_msgs/msg/ClipBatch", METRICS)
CLIP_IMAGES = RecordedTopic("clips/image", "sensor_msgs/msg/Image", METRICS, sequenced=False)
CLIP_SCORES = RecordedTopic("clips/scores", "wm_msgs/msg/ClipScores", METRICS)
VERDICT = RecordedTopic("reward/verdict", "wm_msgs/msg/ClipVerdict", VERDICTS)
VIDEO_VERSION = RecordedTopic("video/version", "wm_msgs/msg/PolicyVersion", LATCHED)

VIDEO_TOPICS = (CLIPS, CLIP_IMAGES, CLIP_SCORES, VIDEO_VERSION, VERDICT, RUN_STATE)
"""Loop 2: clips come every few seconds, asked for one buffer at a time, so a depth of ten holds every unread one."""

DEFAULT_NAMESPACE = "/wm"


def absolute(namespace: str, topic: RecordedTopic) -> str:
    return f"{namespace.rstrip('/')}/{topic.name}"
