"""What a broken or hostile sender may put into messages: every reader returns a value or raises one WireError."""

import math
import random
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from graph.toy import ReachToy, make_policy
from message_generator import MessageGenerator
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image

from wm_msgs.msg import (
    ActionBatch,
    Credit,
    EnvSpec,
    ErrorCode,
    PolicyVersion,
    RewardBatch,
    RewardSummary,
    TaskGoal,
    TransitionBatch,
)
from wm_msgs.srv import ResetBatch, StepBatch
from wm_nodes.config.load import load_config
from wm_nodes.core.errors import WireError
from wm_nodes.core.lockstep import Goals, LockStep
from wm_nodes.nodes.policy.weights import PolicyHolder
from wm_nodes.nodes.reward import summary
from wm_nodes.recording.messages import goals_of, images_of, time_ns
from wm_nodes.reward import RewardResult
from wm_nodes.ros import calls, convert, flow_control
from wm_nodes.ros.flow_control import ProducerCredits
from wm_nodes.ros.sequence_numbers import check_session, new_session
from wm_nodes.ros.wire import Reply, ResetCommand, StepCommand

N = 4
TOY = ReachToy(N, seed=0)
SPEC, OBSERVATION = TOY.spec, TOY.reset()
ZEROS, ONES = np.zeros(N, np.float32), np.ones(N, bool)
TRANSITION = LockStep(
    session=0, stamp_ns=1, next_stamp_ns=2, step_id=3, actions=np.zeros((N, 3), np.float32), states=OBSERVATION.state,
    next_states=OBSERVATION.state, logprobs=ZEROS, values=ZEROS, terminated=~ONES, truncated=~ONES, valid=ONES,
    episode_ids=OBSERVATION.episode_id, episode_steps=OBSERVATION.episode_step,
    policy_versions=np.zeros(N, np.uint64), success_probability=ZEROS, uncertainty=ZEROS,
    ground_truth=TOY.ground_truth, source=SPEC.source,
)
REWARDS = RewardResult(total=ZEROS, dense=ZEROS, sparse=ZEROS, valid=ONES, success=np.zeros(N, np.uint8))
REPLY = Reply(1, 1, 1, OBSERVATION.image, OBSERVATION.state, ~ONES, ~ONES, OBSERVATION.episode_id, ZEROS, ZEROS)
SEEDS = np.zeros(N, np.uint64)

READERS: dict[type[Any], tuple[Any, Callable[[Any], object]]] = {
    EnvSpec: (convert.spec_msg(SPEC, 5), convert.spec_from_msg),
    Image: (convert.mosaic_msg(OBSERVATION.image, 1, SPEC), lambda m: images_of(m, SPEC)),
    TransitionBatch: (convert.transition_msg(TRANSITION), lambda m: convert.transition_of(m, SPEC)),
    TaskGoal: (
        convert.goal_msg(Goals(1, OBSERVATION.image, ONES, OBSERVATION.episode_id), SPEC),
        lambda m: goals_of(m, SPEC),
    ),
    RewardBatch: (convert.reward_msg(TRANSITION, REWARDS, name="rule", version=1, eval_s=0.1), convert.rewards_of),
    ActionBatch: (ActionBatch(num_envs=N, action=[0.0] * 3 * N), lambda m: convert.action_of(m, SPEC)),
    StepBatch.Request: (
        calls.step_request(StepCommand(1, 1, SPEC.spec_hash, np.zeros(3 * N, np.float32), reset_seeds=SEEDS)),
        lambda m: calls.step_command(m, SPEC),
    ),
    ResetBatch.Request: (
        calls.reset_request(ResetCommand(ONES, SEEDS)), lambda m: calls.reset_command(m, SPEC)
    ),
    StepBatch.Response: (
        calls.fill_response(StepBatch.Response(), REPLY, SPEC), lambda m: calls.reply_of(m, SPEC, 1)
    ),
    ResetBatch.Response: (
        calls.fill_response(ResetBatch.Response(), REPLY, SPEC), lambda m: calls.reply_of(m, SPEC)
    ),
}


@pytest.mark.parametrize("kind", READERS, ids=lambda kind: kind.__name__)
def test_a_reader_returns_or_refuses_by_one_wire_error_whatever_a_message_holds(kind: type[Any]) -> None:
    sample, read = READERS[kind]
    read(sample)
    seed = random.randrange(2**32)
    generator = MessageGenerator(seed)
    generator.learn(kind, bytes(serialize_message(sample)))
    refused = 0
    for _ in range(500):
        message = generator.request(kind)
        try:
            read(message)
        except WireError:
            refused += 1
        except Exception as error:
            pytest.fail(f"seed {seed}: {error!r} by {message!r:.3000}")
    assert 0 < refused < 500


@pytest.mark.parametrize("stamp", [Time(sec=-1), Time(nanosec=10**9), Time(sec=2**31 - 1, nanosec=2**32 - 1)])
def test_a_stamp_that_no_clock_gives_is_refused(stamp: Time) -> None:
    with pytest.raises(WireError, match="is no time") as refused:
        time_ns(stamp)
    assert refused.value.code == ErrorCode.OUT_OF_RANGE


def test_a_reward_or_a_transition_that_is_no_number_is_refused_where_it_says_that_it_is_valid() -> None:
    reward = convert.reward_msg(TRANSITION, REWARDS, name="rule", version=1, eval_s=0.0)
    reward.total[1] = float("nan")
    with pytest.raises(WireError, match="total of a valid reward is NaN"):
        convert.rewards_of(reward)
    reward.valid[1] = 0
    assert np.isnan(convert.rewards_of(reward).total[1])
    step = convert.transition_msg(TRANSITION)
    step.next_state[0] = float("inf")
    with pytest.raises(WireError, match="next_states of a valid transition"):
        convert.transition_of(step, SPEC)
    step.valid[0] = 0
    assert convert.transition_of(step, SPEC).valid.tolist() == [False, True, True, True]


def test_simulator_truth_of_another_size_is_refused_and_none_is_unknown() -> None:
    step = convert.transition_msg(TRANSITION)
    step.ground_truth = [0.0] * (3 * N)
    with pytest.raises(WireError, match="ground_truth has 12 values"):
        convert.transition_of(step, SPEC)
    step.ground_truth = []
    truth = convert.transition_of(step, SPEC).ground_truth
    assert truth.shape == (N, SPEC.ground_truth_dim) and np.isnan(truth).all()


def test_a_session_is_the_announced_one_or_a_later_start() -> None:
    known = new_session()
    check_session(known, known)
    check_session(time.time_ns(), known)
    for session in (0, known - 1, 2**64 - 1):
        with pytest.raises(WireError, match="is neither the announced"):
            check_session(session, known)


def test_consumers_that_nobody_can_tell_apart_from_real_ones_take_no_memory() -> None:
    credits = ProducerCredits("env/transition", session=5)
    for number in range(3 * flow_control.MAX_CONSUMERS):
        credits.note(Credit(consumer=f"/wm/{number}", topic="env/transition", stream_session=5, granted_seq=2**64 - 1))
        credits.note(Credit(consumer="/wm/learner", topic="env/transition", stream_session=5, granted_seq=7))
    assert len(credits.consumers) == flow_control.MAX_CONSUMERS
    assert credits.blocking_consumers(8) == ["/wm/learner"]


def test_episodes_that_never_end_take_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(summary, "EPISODES_KEPT", 2 * N)
    window = summary.SummaryWindow()
    for number in range(10):
        ids = np.arange(N, dtype=np.uint64) + number * N
        window.add(convert.transition_of(convert.transition_msg(_renamed(ids)), SPEC), REWARDS)
    assert len(window._returns) == 2 * N


def test_a_summary_of_invalid_rewards_has_no_means_and_says_how_many_there_are() -> None:
    window = summary.SummaryWindow()
    assert window.take() is None
    window.add(TRANSITION, replace(REWARDS, valid=np.zeros(N, bool)))
    values = window.take()
    assert values is not None and values["invalid"] == TRANSITION.valid.sum() > 0
    none = ("mean_total", "mean_dense", "mean_sparse", "min_total", "max_total")
    assert all(math.isnan(values[name]) for name in none)
    assert RewardSummary(**values).invalid == values["invalid"]
    assert not window._rewards and window.take() is None
    window.invalid += 3  # lock-steps that were missed
    assert (window.take() or {})["invalid"] == 3


def _renamed(ids: Any) -> LockStep:
    return replace(TRANSITION, episode_ids=ids)


def test_a_version_without_a_sha256_is_refused(tmp_path: Any) -> None:
    holder = PolicyHolder(make_policy(load_config("smoke")))
    with pytest.raises(WireError, match="has no sha256"):
        holder.follow(PolicyVersion(version=3, inline_data=[1, 2, 3]), tmp_path)
    assert holder.version == 0


def test_equal_seeds_draw_equal_messages_and_other_seeds_others() -> None:
    def draw(seed: int) -> list[bytes]:
        generator = MessageGenerator(seed)
        return [generator.next(kind) for kind in READERS for _ in range(50)]

    assert draw(3) == draw(3) != draw(4)
