"""Lock-step rules: the stamp of an observation; NaN of the model, an environment that raises, the emergency stop."""

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("wm_msgs.msg", reason="wm_msgs is not built")

from graph.toy import ReachToy

from wm_msgs.msg import EpisodeEvent, ErrorCode
from wm_nodes.core.errors import WireError
from wm_nodes.core.lockstep import Goals, LockStep
from wm_nodes.core.types import FloatArray, Observation, StepResult, UInt8Array
from wm_nodes.nodes.environment.asynchronous import AsynchronousEnvironment
from wm_nodes.nodes.environment.lockstep import LockstepEnvironment
from wm_nodes.nodes.environment.remote_environment import RemoteEnvironment
from wm_nodes.nodes.environment.stamp_clock import StampClock
from wm_nodes.ros.clients import LocalEnvironmentClient
from wm_nodes.ros.wire import EpisodeNote, PeerLost, ResetCommand, StepCommand

N = 2


class Fragile(ReachToy):
    """Raises `error` in the next step, gives NaN in environment 0, or fails for good there, when told to."""

    error: Exception | None = None
    nan = failed = False

    def step(self, actions: FloatArray) -> StepResult:
        error, self.error = self.error, None
        if error is not None:
            raise error
        result = super().step(actions)
        if self.nan:
            result.observation.state[0] = np.nan
        if self.failed:
            result.terminated[0] = result.truncated[0] = True
        return result


class Bench:
    """A lock-step environment over Fragile; it is also the sink. now_ns: stands still until a test changes it."""

    def __init__(self, now_ns: int = 1_764_000_000_000_000_000) -> None:
        self.now_ns = now_ns
        self.transitions: list[LockStep] = []
        self.notes: list[EpisodeNote] = []
        self.image_stamps: list[int] = []
        self.goal_stamps: list[int] = []
        self.environment = Fragile(N, seed=0, max_episode_steps=50)
        self.served = LockstepEnvironment(self.environment, 1, self, clock=StampClock(lambda: self.now_ns))
        self.served.reset(ResetCommand(seeds=np.full(N, 3, np.uint64)))

    def image(self, images: UInt8Array, stamp_ns: int) -> None:
        self.image_stamps.append(stamp_ns)

    def goals(self, goals: Goals) -> None:
        self.goal_stamps.append(goals.stamp_ns)

    def transition(self, transition: LockStep) -> None:
        self.transitions.append(transition)

    def episode(self, note: EpisodeNote) -> None:
        self.notes.append(note)

    def command(self) -> StepCommand:
        zeros = np.zeros(N * 3, np.float32)
        return StepCommand(1, self.served.next_step_id, self.environment.spec.spec_hash, zeros)

    def ends(self) -> list[tuple[int, int]]:
        """(environment, reason) of the END events."""
        return [(note.env_index, note.reason) for note in self.notes if note.kind == EpisodeEvent.KIND_END]


def test_everything_about_an_observation_has_the_time_at_which_it_was_made_for_its_stamp() -> None:
    bench = Bench(now_ns=1_764_000_000_000_000_000)
    bench.now_ns += 5_000_000
    reply = bench.served.step(replace(bench.command(), reset_mask=np.array([True, False])))
    assert bench.image_stamps == bench.goal_stamps == [1_764_000_000_000_000_000, 1_764_000_000_005_000_000]
    first, second = bench.image_stamps
    assert [(t.stamp_ns, t.next_stamp_ns) for t in bench.transitions] == [(first, first), (first, second)]
    assert reply.stamp_ns == second
    assert [(note.kind, note.stamp_ns) for note in bench.notes[-2:]] == [
        (EpisodeEvent.KIND_END, first), (EpisodeEvent.KIND_START, second),
    ]


def test_stamps_become_later_although_the_clock_stands_still_or_jumps_back() -> None:
    bench = Bench(now_ns=1000)
    for now_ns in (1000, 400, 1001, 1003, 2000):
        bench.now_ns = now_ns
        bench.served.step(bench.command())
    assert bench.image_stamps == [1000, 1001, 1002, 1003, 1004, 2000]
    assert Bench(now_ns=0).image_stamps == [1]  # without /clock; 0 is the stamp of an action that answers nothing


def test_an_episode_reset_without_a_seed_names_the_seed_that_makes_it_again() -> None:
    bench = Bench()
    bench.served.reset(ResetCommand())
    drawn = bench.transitions[-1].states.copy()
    seeds = np.array([note.seed for note in bench.notes if note.kind == EpisodeEvent.KIND_START][-N:], np.uint64)
    assert len(set(seeds.tolist())) == N
    bench.served.reset(ResetCommand(seeds=seeds))
    assert (bench.transitions[-1].states == drawn).all()
    other = Bench()
    other.served.reset(ResetCommand())
    assert (other.transitions[-1].states == drawn).all()


def test_a_log_prob_or_value_that_nobody_named_is_nan() -> None:
    bench = Bench()
    bench.served.step(bench.command())
    assert np.isnan(bench.transitions[-1].logprobs).all()
    assert np.isnan(bench.transitions[-1].values).all()


def test_a_failure_for_good_is_both_flags_and_an_end_before_the_limit_by_neither_time_nor_doubt() -> None:
    bench = Bench()
    bench.environment.failed = True
    reply = bench.served.step(bench.command())
    assert reply.ended.tolist() == [True, False] and reply.terminated[0] and reply.truncated[0]
    assert bench.transitions[-1].valid.all() and not bench.transitions[-1].success.any()
    ends = [(note.reason, note.outcome) for note in bench.notes if note.kind == EpisodeEvent.KIND_END]
    assert ends == [(EpisodeEvent.REASON_TERMINAL, EpisodeEvent.OUTCOME_FAILURE)]


def test_nan_of_the_model_is_an_error_again_on_retry_and_nothing_of_it_is_valid_until_the_reset() -> None:
    bench = Bench()
    bench.environment.nan = True
    command = bench.command()
    for _ in range(2):
        with pytest.raises(WireError, match=r"environments \[0\]") as refused:
            bench.served.step(command)
        assert refused.value.code == ErrorCode.NAN_MODEL
    assert len(bench.transitions) == 2
    assert bench.transitions[-1].valid.tolist() == [False, True]
    assert bench.ends() == [(0, EpisodeEvent.REASON_ERROR)]
    bench.environment.nan = False
    reply = bench.served.step(bench.command())
    assert bench.transitions[-1].valid.tolist() == [False, True]
    assert reply.truncated.tolist() == [True, False]
    reply = bench.served.step(replace(bench.command(), reset_mask=reply.truncated))
    assert reply.truncated.tolist() == [False, False]
    bench.served.step(bench.command())
    assert bench.transitions[-1].valid.all()
    assert bench.ends() == [(0, EpisodeEvent.REASON_ERROR)]


@pytest.mark.parametrize(
    ("error", "code"),
    [(FloatingPointError("predicted NaN"), ErrorCode.NAN_MODEL), (KeyError("cube"), ErrorCode.INTERNAL)],
)
def test_an_environment_that_raises_ends_all_episodes_and_serves_again_after_a_reset(
    error: Exception, code: int
) -> None:
    bench = Bench()
    bench.environment.error = error
    with pytest.raises(WireError, match=f"{type(error).__name__}.*reset them") as refused:
        bench.served.step(bench.command())
    assert refused.value.code == code
    assert refused.value.__cause__ is error
    assert bench.ends() == [(i, EpisodeEvent.REASON_ERROR) for i in range(N)]
    bench.served.step(bench.command())
    assert not bench.transitions[-1].valid.any()
    bench.served.reset(ResetCommand())
    bench.served.step(bench.command())
    assert bench.transitions[-1].valid.all()


@pytest.mark.parametrize("reason", [EpisodeEvent.REASON_ESTOP, EpisodeEvent.REASON_DEACTIVATED])
def test_an_episode_ended_from_outside_stays_ended_until_it_is_reset(reason: int) -> None:
    bench = Bench()
    bench.served.step(bench.command())
    bench.served.end_episodes(reason)
    reply = bench.served.step(bench.command())
    assert reply.truncated.all()
    assert not bench.transitions[-1].valid.any()
    assert not bench.transitions[-1].truncated.any()
    assert bench.ends() == [(i, reason) for i in range(N)]
    bench.served.step(replace(bench.command(), reset_mask=np.ones(N, bool)))
    bench.served.step(bench.command())
    assert bench.transitions[-1].valid.all()
    assert sum(note.kind == EpisodeEvent.KIND_START for note in bench.notes) == 2 * N


def test_the_asynchronous_environment_resets_after_an_error_of_the_environment() -> None:
    bench = Bench()
    clocked = AsynchronousEnvironment(bench.served, lambda: 1.0)
    clocked.start()
    bench.environment.error = OSError("camera unplugged")
    with pytest.raises(WireError, match="camera unplugged"):
        clocked.tick()
    clocked.tick()
    clocked.tick()
    assert bench.transitions[-1].valid.all()


def test_a_local_client_names_a_missing_environment_and_hides_no_fault_of_one() -> None:
    with pytest.raises(PeerLost, match="cleaned up"):
        LocalEnvironmentClient(lambda: None).reset(ResetCommand(), lambda: None)

    class Faulty:
        def reset(self, command: ResetCommand) -> None:
            raise AttributeError("a fault")

    with pytest.raises(AttributeError, match="a fault"):
        LocalEnvironmentClient(Faulty).reset(ResetCommand(), lambda: None)


def test_a_reset_that_was_sent_again_while_it_was_made_is_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    made, reset = list[int](), bench.environment.reset

    def slow(*arguments: Any) -> Observation:
        made.append(len(made))
        time.sleep(0.2)
        return reset(*arguments)

    monkeypatch.setattr(bench.environment, "reset", slow)
    command = ResetCommand(np.ones(N, bool), np.full(N, 5, np.uint64), behaviour="policy")
    again = ResetCommand(np.ones(N, bool), np.full(N, 5, np.uint64), behaviour="policy")
    assert bench.served.reset(command) is bench.served.reset(again)
    assert len(made) == 1 and len(bench.transitions) == 2
    for other in (
        replace(command, seeds=np.full(N, 6, np.uint64)), replace(command, mask=np.array([True, False])),
        replace(command, behaviour="evaluation"), replace(command, seeds=None), replace(command, seeds=None),
    ):
        count = len(made)
        bench.served.reset(other)
        assert len(made) == count + 1
    for between in (
        lambda: bench.served.step(bench.command()), lambda: time.sleep(0.3),
        lambda: bench.served.end_episodes(EpisodeEvent.REASON_ESTOP),
    ):
        bench.served.reset(command)
        count = len(made)
        between()
        bench.served.reset(again)
        assert len(made) == count + 1


def remote(bench: Bench) -> RemoteEnvironment:
    return RemoteEnvironment(LocalEnvironmentClient(lambda: bench.served), lambda: None, timeout_s=1.0)


def test_a_step_is_answered_again_only_to_the_client_that_asked_for_it() -> None:
    bench = Bench()
    command = replace(bench.command(), values=np.full(N, np.nan, np.float32))
    reply = bench.served.step(command)
    assert bench.served.step(replace(command, values=np.full(N, np.nan, np.float32))) is reply
    for changes in ({"actions": np.full(N * 3, 0.5, np.float32)}, {"policy_version": 3}, {"values": None}):
        with pytest.raises(WireError, match=r"nor the last step, sent again; is there a second client\?") as refused:
            bench.served.step(replace(command, **changes))
        assert refused.value.code == ErrorCode.OUT_OF_ORDER
    assert len(bench.transitions) == 2


def test_of_two_clients_of_one_environment_neither_goes_on_with_the_other_s_episodes() -> None:
    bench = Bench()
    first, second = remote(bench), remote(bench)
    first.reset()
    first.step(np.zeros((N, 3), np.float32))
    second.reset()
    with pytest.raises(PeerLost, match=r"another client has reset environments \[0, 1\] within the episode"):
        first.step(np.zeros((N, 3), np.float32))
    with pytest.raises(WireError, match="is there a second client"):
        second.step(np.full((N, 3), 0.5, np.float32))
    first.reset(seeds=np.arange(N, dtype=np.uint64))
    for client, mine, other in ((second, 0, 1), (first, 1, 0)):
        with pytest.raises(PeerLost, match=rf"environments \[{other}\]"):
            client.reset(np.arange(N) == mine)


def test_an_environment_that_one_client_resets_in_part_is_stepped_on() -> None:
    bench = Bench()
    client = remote(bench)
    client.reset()
    client.step(np.zeros((N, 3), np.float32))
    before = client.reset(np.array([False, True])).episode_id
    after = client.step(np.zeros((N, 3), np.float32)).observation.episode_id
    assert (before == after).all()


def test_a_robot_is_left_from_its_last_step_within_an_episode_until_it_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    bench, now_s = Bench(), 10.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)

    def left_for_s() -> float:
        nonlocal now_s
        now_s += 2.0
        return bench.served.left_for_s

    assert left_for_s() == 0.0, "what was only reset stays put"
    bench.served.step(bench.command())
    assert (left_for_s(), left_for_s()) == (2.0, 4.0)
    bench.served.reset(ResetCommand())
    assert left_for_s() == 2.0, "a reset need not end what a step began"
    bench.served.hold_now()
    assert left_for_s() == 0.0
    while bench.served._episodes.running.any():
        bench.served.step(bench.command())
    assert left_for_s() == 0.0, "at the end of its episode a robot holds by itself"
    bench.environment.error = OSError("no answer")
    with pytest.raises(WireError, match="no answer"):
        bench.served.step(bench.command())
    assert left_for_s() == 2.0, "whatever a failed step began"
    bench.served.hold_now()
    bench.served.reset(ResetCommand())
    assert left_for_s() == 0.0
    bench.served.end_episodes(EpisodeEvent.REASON_ESTOP)
    bench.served.step(bench.command())
    assert left_for_s() == 2.0, "an episode that was ended from outside is no rest"
