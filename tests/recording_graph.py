"""What a live graph publishes, without the graph: several environments in one mosaic, rewards that lag, resets."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import Rollout
from wm_nodes.recording import RawBagWriter, topics
from wm_nodes.recording import messages as m
from wm_nodes.recording.layout import Tiles

PERIOD_NS = 100_000_000
NUM_ENVS = 3


@dataclass
class Graph:
    """Publishes as the environment node and the reward evaluator do; keeps what a learner would have been given.

    Environment i ends every episode after 2 + i steps, waits one lock-step (valid=0, reset), and starts the next.
    """

    spec: EnvironmentSpec
    session: int = 7
    reward_lag: int = 3
    start_ns: int = 0
    """Stamps go on from here by the control period."""
    published: list[tuple[topics.RecordedTopic, Any, int]] = field(default_factory=list)
    rollouts: list[Rollout] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.session)
        self.now_ns, self.clock_ns, self.step_id = self.start_ns, 0, 0
        self.sequence: dict[str, int] = {}
        self.rewards: list[tuple[int, Any]] = []
        self.episode_id = np.zeros(NUM_ENVS, np.uint64)
        self.episode_step = np.zeros(NUM_ENVS, np.uint32)
        self.next_id = 1
        self.publish(topics.SPEC, m.spec_message(self.spec, 0, self.session))

    def publish(self, topic: topics.RecordedTopic, message: Any) -> None:
        self.clock_ns += 1_000_000
        if topic.sequenced:
            message.session, message.seq = self.session, self.sequence.get(topic.name, 0)
            self.sequence[topic.name] = message.seq + 1
        self.published.append((topic, message, self.clock_ns))

    def observe(self) -> None:
        spec = self.spec
        self.images = self.rng.integers(0, 256, (NUM_ENVS, spec.height, spec.width, 3), dtype=np.uint8)
        self.states = self.rng.normal(size=(NUM_ENVS, spec.state_dim)).astype(np.float32)
        self.truth = self.rng.normal(size=(NUM_ENVS, spec.ground_truth_dim)).astype(np.float32)
        self.now_ns += PERIOD_NS
        mosaic = Tiles.of(NUM_ENVS, spec.height, spec.width).tile(self.images)
        self.publish(topics.IMAGES, m.image_message(mosaic, self.now_ns))

    def event(self, index: int, kind: int, reason: int) -> None:
        message = m.message_type(topics.EPISODE.msgtype)(
            header=m.header(self.now_ns, ""), session=0, seq=0, kind=kind, env_index=index,
            episode_id=int(self.episode_id[index]), seed=500 + int(self.episode_id[index]), task="push_cube",
            instruction="push", behaviour="policy", length=int(self.episode_step[index]), outcome=0,
            termination_reason=reason, policy_version_first=0, policy_version_last=0, source=1,
        )
        self.publish(topics.EPISODE, message)

    def start(self, mask: NDArray[np.bool_]) -> None:
        for index in np.flatnonzero(mask):
            self.episode_id[index], self.episode_step[index] = self.next_id, 0
            self.next_id += 1
            self.event(int(index), m.KIND_START, m.REASON_NONE)

    def transition(self, **changes: Any) -> Any:
        zeros, none = np.zeros(NUM_ENVS, np.float32), np.zeros(NUM_ENVS, np.uint8)
        fields = {
            "header": m.header(self.now_ns, ""), "session": 0, "seq": 0, "next_stamp": m.stamp(self.now_ns),
            "step_id": self.step_id, "num_envs": NUM_ENVS, "action": np.zeros(NUM_ENVS * 3, np.float32),
            "state": self.states.reshape(-1), "next_state": self.states.reshape(-1), "log_prob": zeros, "value": zeros,
            "terminated": none, "truncated": none, "valid": none, "episode_id": self.episode_id.copy(),
            "episode_step": self.episode_step.copy(), "policy_version": np.zeros(NUM_ENVS, np.uint64),
            "success_probability": zeros, "model_uncertainty": zeros, "ground_truth": self.truth.reshape(-1),
            "source": 1,
        }
        return m.message_type(topics.TRANSITION.msgtype)(**{**fields, **changes})

    def reset(self) -> None:
        self.observe()
        self.ended = np.zeros(NUM_ENVS, bool)
        self.start(np.ones(NUM_ENVS, bool))
        self.publish(topics.TRANSITION, self.transition())

    def step(self, version: int) -> dict[str, NDArray[Any]]:
        reset, old_id, old_step = self.ended.copy(), self.episode_id.copy(), self.episode_step.copy()
        images, states, stamp_ns = self.images, self.states, self.now_ns
        self.step_id += 1
        self.observe()
        rng = self.rng
        row: dict[str, NDArray[Any]] = {
            "images": images,
            "states": states,
            "next_images": self.images,
            "next_states": self.states,
            "actions": rng.uniform(-1, 1, (NUM_ENVS, 3)).astype(np.float32),
            "logprobs": rng.normal(size=NUM_ENVS).astype(np.float32),
            "values": rng.normal(size=NUM_ENVS).astype(np.float32),
            "rewards": rng.normal(size=NUM_ENVS).astype(np.float32),
            "truncated": ~reset & (old_step + 1 == 2 + np.arange(NUM_ENVS)),
            "terminated": np.zeros(NUM_ENVS, bool),
            "valid": ~reset & (rng.random(NUM_ENVS) > 0.2),
        }
        self.success = success = rng.random(NUM_ENVS).astype(np.float32)
        message = self.transition(
            header=m.header(stamp_ns, ""), action=row["actions"].reshape(-1), state=states.reshape(-1),
            log_prob=row["logprobs"], value=row["values"], truncated=row["truncated"].astype(np.uint8),
            valid=(~reset).astype(np.uint8), policy_version=np.full(NUM_ENVS, version, np.uint64),
            success_probability=success, episode_id=old_id, episode_step=old_step,
        )
        self.publish(topics.TRANSITION, message)
        if reset.all():
            row["rewards"][:] = np.nan  # nobody stepped: the evaluator says nothing
        else:
            self.rewards.append((self.step_id + self.reward_lag, self.reward(row, stamp_ns)))
        self.flush_rewards(self.step_id)
        self.episode_step[~reset] += 1
        for index in np.flatnonzero(row["truncated"]):
            self.event(int(index), m.KIND_END, m.REASON_TIME_LIMIT)
        self.start(reset)
        self.ended = row["truncated"]
        return row

    def reward(self, row: dict[str, NDArray[Any]], stamp_ns: int) -> Any:
        zeros = np.zeros(NUM_ENVS, np.float32)
        return m.message_type(topics.REWARD.msgtype)(
            header=m.header(stamp_ns, ""), session=0, seq=0, transition_session=self.session, step_id=self.step_id,
            num_envs=NUM_ENVS, total=row["rewards"], dense=zeros, sparse=zeros, component_names=["total"],
            components=row["rewards"], weights=np.ones(1, np.float32), success=np.zeros(NUM_ENVS, np.uint8),
            valid=row["valid"].astype(np.uint8), invalid_reason="", reward_version=1, reward_name="rule", eval_ms=1.0,
        )

    def flush_rewards(self, step_id: int) -> None:
        while self.rewards and self.rewards[0][0] <= step_id:
            self.publish(topics.REWARD, self.rewards.pop(0)[1])

    def rollout(self, version: int, steps: int, *, reset: bool = True) -> None:
        if reset:
            self.reset()
        rows = [self.step(version) for _ in range(steps)]
        arrays = {f"{name}_TN": np.stack([row[name] for row in rows]) for name in rows[0]}
        self.rollouts.append(Rollout(**arrays, policy_version=version))


def write(
    path: Path, *graphs: Graph, drop: Callable[[topics.RecordedTopic, Any], bool] = lambda topic, message: False
) -> Path:
    offset = 0
    with RawBagWriter(path, chunk_bytes=4096) as bag:
        for topic in topics.ALL_TOPICS:
            bag.add_topic(topics.absolute("/wm", topic), topic.msgtype, [topic.qos])
        for graph in graphs:
            graph.flush_rewards(10**9)
            for topic, message, time_ns in graph.published:
                if not drop(topic, message):
                    bag.write(topics.absolute("/wm", topic), m.serialize(message), offset + time_ns)
            offset += graph.clock_ns + 2_000_000_000
    return path


def assert_same_rollout(found: Rollout, expected: Rollout) -> None:
    for name, value in vars(expected).items():
        np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)
        if isinstance(value, np.ndarray):
            assert getattr(found, name).dtype == value.dtype, name
