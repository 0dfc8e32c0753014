"""EpisodeBagWriter: whole episodes into a bag with the topics of the live graph, one environment per image.

What one episode of T steps becomes (namespace /wm; n = frame, s_n = stamp of frame n, strictly increasing):

    s_0       env/image       frame 0
    s_0       episode         KIND_START
    s_0       env/transition  the reset: valid=0, header.stamp = next_stamp = s_0, zero action; next_state, ground_truth
                              and success_probability are those of frame 0
    s_n       env/image       frame n = 1..T
    s_n       env/transition  action n-1, header.stamp = s_(n-1), next_stamp = s_n; ground_truth etc. of frame n
    s_n       reward          of that transition (no message where the reward is missing)
    s_T       episode         KIND_END

The live environment node publishes the same reset transition after env/reset, so that frame 0's truth is never lost.
Its step_id is that of the last step before it: it answers no StepBatch request.
"""

import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wm_nodes.core.lockstep import LockStep
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import Episode, FloatArray
from wm_nodes.recording import messages as m
from wm_nodes.recording import topics
from wm_nodes.recording.raw import EPISODE_RECORD, EPISODE_TABLE, RawBagWriter

TABLE_COLUMNS = (
    "episode_id", "first_stamp_ns", "length", "seed", "task", "instruction", "behaviour", "source", "policy_version",
    "success", "terminated", "truncated", "return_total", "extra",
)


class EpisodeBagWriter:
    """Write recorded episodes into one rosbag2 MCAP folder; use as a context manager.

    Every written episode survives a kill of the process (see recover). One process writes one bag.

    Args:
        path: the folder to make; `<path>.partial` until closed.
        spec: of the environments the episodes came from; recorded with num_envs=1.
        run_id: custom_data wm.run_id.
        custom: more custom_data, e.g. wm.git_commit, wm.world_model_sha256; all strings.
        split_bytes: a new .mcap file starts at the first episode after this many bytes.
        start_ns: stamp of the first frame, ns since the epoch; the wall clock when None.
        discard_partial: start over where a killed process left `<path>.partial`, instead of raising BagError.
    """

    def __init__(
        self, path: Path, spec: EnvironmentSpec, *, run_id: str, custom: Mapping[str, str] | None = None,
        namespace: str = topics.DEFAULT_NAMESPACE, reward_name: str = "recorded", split_bytes: int = 2**28,
        start_ns: int | None = None, discard_partial: bool = False,
    ) -> None:
        self.spec = replace(spec, num_envs=1)
        self.path = Path(path)
        self.num_episodes = 0
        self._now_ns = time.time_ns() if start_ns is None else start_ns
        self._session = self._now_ns
        self._period_ns = max(1, round(spec.control_period_s * m.NS_PER_S))
        self._reward_name = reward_name
        self._split_bytes = split_bytes
        self._next_step_id = 1
        self._sequence: dict[str, int] = {}
        self._rows: list[list[Any]] = []
        self._seen: set[int] = set()
        self._names = {topic: topics.absolute(namespace, topic) for topic in topics.ALL_TOPICS}
        fixed = {"wm.run_id": run_id, "wm.spec_json": m.spec_to_json(self.spec), "wm.writer": "EpisodeBagWriter"}
        custom = {**(custom or {}), **fixed}
        self._bag = RawBagWriter(self.path, custom=custom, split_bytes=0, discard_partial=discard_partial)
        for topic in (topics.SPEC, topics.IMAGES, topics.TRANSITION, topics.REWARD, topics.EPISODE):
            self._bag.add_topic(self._names[topic], topic.msgtype, [topic.qos])
        self._write(topics.SPEC, m.spec_message(self.spec, self._now_ns, self._session), self._now_ns)
        self._bag.flush()

    def write(self, episode: Episode) -> None:
        """Append one episode.

        Raises:
            ValueError: an array does not fit the spec, an action is not finite, or episode_id was written before.
            RecordingError: the disk is full.
        """
        self._check(episode)
        try:
            extra = json.loads(json.dumps(dict(episode.extra)))
        except TypeError as error:
            raise ValueError(f"episode {episode.episode_id}: extra must be JSON values: {error}") from None
        if self._bag.bytes_in_file >= self._split_bytes:
            self._bag.split()
        stamps = [self._now_ns + n * self._period_ns for n in range(episode.num_steps + 1)]
        row = self._row(episode, stamps[0], extra)
        self._bag.add_record(EPISODE_RECORD, {"row": json.dumps(dict(zip(TABLE_COLUMNS, row)))})
        self._write_reset(episode, stamps[0])
        for step in range(episode.num_steps):
            self._write_step(episode, step, stamps[step], stamps[step + 1])
        self._write(topics.EPISODE, self._event(episode, m.KIND_END, stamps[-1]), stamps[-1] + 3)
        self._bag.flush()
        self._now_ns = stamps[-1] + self._period_ns
        self._seen.add(episode.episode_id)
        self._rows.append(row)
        self.num_episodes += 1

    def close(self) -> Path:
        """Complete the bag and give it its final name, which is returned."""
        self._bag.custom[EPISODE_TABLE] = json.dumps({"columns": TABLE_COLUMNS, "rows": self._rows})
        versions = sorted({row[TABLE_COLUMNS.index("policy_version")] for row in self._rows})
        self._bag.custom["wm.policy_versions"] = json.dumps(versions)
        return self._bag.close()

    def __enter__(self) -> "EpisodeBagWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self._bag.abort(remove=self.num_episodes == 0)

    def _write(self, topic: topics.RecordedTopic, message: Any, time_ns: int) -> None:
        self._bag.write(self._names[topic], m.serialize(message), time_ns)

    def _seq(self, topic: topics.RecordedTopic) -> int:
        number = self._sequence.get(topic.name, 0)
        self._sequence[topic.name] = number + 1
        return number

    def _write_reset(self, episode: Episode, now_ns: int) -> None:
        self._write(topics.IMAGES, m.image_message(episode.images[0], now_ns), now_ns)
        self._write(topics.EPISODE, self._event(episode, m.KIND_START, now_ns), now_ns + 1)
        reset = self._transition(episode, -1, now_ns, now_ns)
        self._write(topics.TRANSITION, reset, now_ns + 2)

    def _write_step(self, episode: Episode, step: int, now_ns: int, next_ns: int) -> None:
        self._write(topics.IMAGES, m.image_message(episode.images[step + 1], next_ns), next_ns)
        self._write(topics.TRANSITION, self._transition(episode, step, now_ns, next_ns), next_ns + 1)
        if not np.isnan(episode.rewards[step]):
            self._write(topics.REWARD, self._reward(episode, step, now_ns), next_ns + 2)
        self._next_step_id += 1

    def _transition(self, episode: Episode, step: int, now_ns: int, next_ns: int) -> Any:
        """Transition of action `step`; step -1 is the reset that shows frame 0."""
        is_reset, is_last = step < 0, step == episode.num_steps - 1
        frame = step + 1
        truth, action, state = episode.ground_truth[frame], episode.actions[max(step, 0)], episode.states[max(step, 0)]
        unknown = np.full(1, np.nan, np.float32)
        lockstep = LockStep(
            session=self._session, step_id=self._next_step_id - is_reset, stamp_ns=now_ns, next_stamp_ns=next_ns,
            actions=_floats(np.zeros_like(action) if is_reset else action)[None], states=_floats(state)[None],
            next_states=_floats(episode.states[frame])[None], logprobs=unknown, values=unknown,
            terminated=np.array([is_last and episode.terminated], bool),
            truncated=np.array([is_last and episode.truncated], bool), valid=np.array([not is_reset]),
            episode_ids=np.array([episode.episode_id], np.uint64), episode_steps=np.array([max(step, 0)], np.uint32),
            policy_versions=np.array([episode.policy_version], np.uint64),
            success_probability=np.array([episode.success[frame]], np.float32),
            uncertainty=np.zeros(1, np.float32), ground_truth=_floats([] if np.isnan(truth).all() else truth)[None],
            source=episode.source,
        )
        return m.lockstep_message(lockstep, self._seq(topics.TRANSITION))

    def _reward(self, episode: Episode, step: int, now_ns: int) -> Any:
        reward = _floats(episode.rewards[step])
        return m.message_type(topics.REWARD.msgtype)(
            header=m.header(now_ns, m.BASE_FRAME), session=self._session, seq=self._seq(topics.REWARD),
            transition_session=self._session, step_id=self._next_step_id, num_envs=1, total=reward,
            dense=np.zeros(1, np.float32), sparse=np.zeros(1, np.float32), component_names=["total"], components=reward,
            weights=np.ones(1, np.float32), success=_flag(episode.success[step + 1]), valid=_flag(True),
            invalid_reason="", reward_version=0, reward_name=self._reward_name, eval_ms=0.0,
        )

    def _event(self, episode: Episode, kind: int, now_ns: int) -> Any:
        is_end = kind == m.KIND_END
        reason = m.REASON_TERMINAL if episode.terminated else m.REASON_TIME_LIMIT
        if not (episode.terminated or episode.truncated):
            reason = m.REASON_RESET
        outcome = m.OUTCOME_SUCCESS if episode.success[-1] else m.OUTCOME_FAILURE
        return m.message_type(topics.EPISODE.msgtype)(
            header=m.header(now_ns, m.BASE_FRAME), session=self._session, seq=self._seq(topics.EPISODE), kind=kind,
            env_index=0, episode_id=episode.episode_id, seed=episode.seed, task=episode.task,
            instruction=episode.instruction, behaviour=episode.behaviour, length=episode.num_steps if is_end else 0,
            outcome=outcome if is_end else m.OUTCOME_UNKNOWN, termination_reason=reason if is_end else m.REASON_NONE,
            policy_version_first=episode.policy_version, policy_version_last=episode.policy_version,
            source=episode.source,
        )

    def _row(self, episode: Episode, first_ns: int, extra: Any) -> list[Any]:
        total = float(np.sum(episode.rewards, dtype=np.float64))
        return [
            int(episode.episode_id), first_ns, episode.num_steps, int(episode.seed), episode.task, episode.instruction,
            episode.behaviour, int(episode.source), int(episode.policy_version), bool(episode.success[-1]),
            bool(episode.terminated), bool(episode.truncated), None if np.isnan(total) else total, extra,
        ]

    def _check(self, episode: Episode) -> None:
        spec, frames = self.spec, episode.num_steps + 1
        name = f"episode {episode.episode_id}"
        if frames < 2:
            raise ValueError(f"{name} has no steps; an episode needs at least one action")
        if episode.images.dtype != np.uint8:
            raise ValueError(f"{name}: images must be uint8, got {episode.images.dtype}")
        shapes = {
            "images": (frames, spec.height, spec.width, spec.channels),
            "states": (frames, spec.state_dim),
            "actions": (frames - 1, spec.action_dim),
            "ground_truth": (frames, spec.ground_truth_dim),
            "success": (frames,),
            "rewards": (frames - 1,),
        }
        for array, expected in shapes.items():
            shape = getattr(episode, array).shape
            if shape != expected:
                raise ValueError(f"{name}: {array} has shape {shape}, but the spec {spec.env_id} asks for {expected}")
        if not np.isfinite(episode.actions).all() or np.abs(episode.actions).max() > 1 + 1e-6:
            raise ValueError(f"{name}: actions must be finite and in [-1, 1]; store them as executed, after clipping")
        if episode.episode_id in self._seen:
            raise ValueError(f"{name} was written before; episode_id must be unique within a bag")


def _floats(values: Any) -> FloatArray:
    return np.asarray(values, np.float32).reshape(-1)


def _flag(value: Any) -> Any:
    return np.array([bool(value)], np.uint8)
