"""The environment's own clock: which action a step takes, when it holds, what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("wm_msgs.msg", reason="wm_msgs is not built")

from graph.toy import ReachToy

from wm_msgs.msg import EpisodeEvent, ErrorCode
from wm_nodes.core.errors import WireError
from wm_nodes.core.lockstep import Goals, LockStep
from wm_nodes.core.specs import SOURCE_IMAGINED, SOURCE_REAL, SOURCE_SIMULATOR
from wm_nodes.core.types import FloatArray, StepResult, UInt8Array
from wm_nodes.nodes.environment.asynchronous import AsynchronousEnvironment
from wm_nodes.nodes.environment.lockstep import LockstepEnvironment
from wm_nodes.ros.wire import EpisodeNote, ResetCommand, TimedAction

N = 2


class Published:
    """A sink that keeps what the environment publishes."""

    def __init__(self) -> None:
        self.transitions: list[LockStep] = []
        self.stamps: list[int] = []
        self.notes: list[EpisodeNote] = []

    def image(self, images: UInt8Array, stamp_ns: int) -> None:
        self.stamps.append(stamp_ns)

    def goals(self, goals: Goals) -> None: ...

    def transition(self, transition: LockStep) -> None:
        self.transitions.append(transition)

    def episode(self, note: EpisodeNote) -> None:
        self.notes.append(note)


class Bench:
    """source: EnvSpec.SOURCE_* of the environment."""

    def __init__(self, source: int = SOURCE_SIMULATOR) -> None:
        self.now = 0.0
        self.published = Published()
        toy = ReachToy(N, seed=1)
        toy.spec = replace(toy.spec, source=source)
        self.served = LockstepEnvironment(toy, 7, self.published)
        self.moved = self._noted(toy)
        self.environment = AsynchronousEnvironment(self.served, lambda: 0.25, lambda: self.now)
        self.environment.start()

    @staticmethod
    def _noted(toy: ReachToy) -> list[FloatArray]:
        """The actions of the steps that the environment makes from now on."""
        moved, step = list[FloatArray](), toy.step

        def note(actions: FloatArray) -> StepResult:
            moved.append(actions)
            return step(actions)

        toy.step = note  # type: ignore[method-assign]
        return moved

    def refuse_credit(self, refused: bool) -> None:
        def wait() -> None:
            if refused:
                raise WireError(ErrorCode.BUSY, "waiting for /wm/learner")

        self.served.before_step = wait

    def tick(self) -> bool:
        self.now += 0.1
        return self.environment.tick()

    def offer(self, value: float, stamp_ns: int | None = None) -> None:
        stamp = self.published.stamps[-1] if stamp_ns is None else stamp_ns
        self.environment.offer(TimedAction(np.full(3 * N, value, np.float32), stamp, policy_version=5))

    @property
    def last(self) -> LockStep:
        return self.published.transitions[-1]


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_an_action_is_used_until_its_observation_is_too_old_then_the_tool_is_held(bench: Bench) -> None:
    assert not bench.tick()
    assert not bench.last.actions.any()
    bench.offer(0.5)
    assert [bench.tick() for _ in range(3)] == [True, True, False]
    used = [float(step.actions[0, 0]) for step in bench.published.transitions[-3:]]
    assert used == [0.5, 0.5, 0.0]
    assert [int(step.policy_versions[0]) for step in bench.published.transitions[-3:]] == [5, 5, 0]


def test_an_action_on_an_old_or_unknown_observation_is_refused_and_the_newer_one_stays(bench: Bench) -> None:
    old = bench.published.stamps[-1]
    for _ in range(4):
        bench.tick()
    bench.offer(0.5)
    with pytest.raises(WireError, match=r"0\.400 s old, max_action_age_s is 0\.25") as refused:
        bench.offer(0.1, old)
    assert refused.value.code == ErrorCode.TIMEOUT
    with pytest.raises(WireError, match="unknown"):
        bench.offer(0.1, 12345)
    assert bench.tick()
    assert bench.last.actions[0, 0] == 0.5


@pytest.mark.parametrize(("value", "code"), [(np.nan, ErrorCode.NAN_INPUT), (1.5, ErrorCode.OUT_OF_RANGE)])
def test_a_bad_action_is_refused_when_it_arrives(bench: Bench, value: float, code: int) -> None:
    with pytest.raises(WireError) as refused:
        bench.offer(value)
    assert refused.value.code == code
    assert not bench.tick()


def test_a_persons_action_ages_from_its_arrival_and_hold_ends_it_at_once(bench: Bench) -> None:
    bench.offer(0.5, stamp_ns=0)
    assert bench.tick()
    bench.environment.hold()
    assert not bench.tick()


def test_ended_environments_are_reset_in_the_next_step(bench: Bench) -> None:
    for _ in range(12):
        bench.tick()
    assert bench.last.truncated.all()
    bench.tick()
    assert not bench.last.valid.any()
    bench.tick()
    assert bench.last.valid.all()
    assert (bench.last.episode_steps == 0).all()


def test_a_reset_by_request_takes_the_place_of_the_one_that_was_due(bench: Bench) -> None:
    for _ in range(12):
        bench.tick()
    bench.environment.reset(ResetCommand())
    bench.offer(0.5)
    assert bench.tick()
    assert bench.last.valid.all()


def test_an_emergency_stop_holds_at_once_and_neither_keeps_nor_takes_an_action(bench: Bench) -> None:
    bench.offer(0.5)
    bench.tick()
    count, made = len(bench.published.transitions), len(bench.moved)
    bench.served.estop = True
    bench.environment.stop()
    assert len(bench.moved) == made + 1 and not bench.moved[-1].any() and len(bench.published.transitions) == count
    with pytest.raises(WireError, match="emergency stop") as refused:
        bench.offer(0.5)
    assert refused.value.code == ErrorCode.ESTOP
    bench.served.estop = False
    assert not bench.tick() and not bench.last.actions.any()


def test_the_emergency_stop_and_missing_credit_leave_the_environment_as_it_is(bench: Bench) -> None:
    count = len(bench.published.transitions)
    bench.served.estop = True
    with pytest.raises(WireError, match="emergency stop"):
        bench.tick()
    assert len(bench.published.transitions) == count
    bench.served.estop = False
    bench.tick()
    assert len(bench.published.transitions) == count + 1


def test_what_is_imagined_stands_still_and_is_not_told_to_hold() -> None:
    bench = Bench(SOURCE_IMAGINED)
    bench.environment.stop()
    assert not bench.moved


def test_a_robot_holds_once_while_it_waits_for_credit_and_its_episode_goes_on_without_a_gap() -> None:
    bench = Bench(SOURCE_REAL)
    bench.offer(0.5)
    bench.tick()
    bench.refuse_credit(True)
    for _ in range(3):
        with pytest.raises(WireError, match="waiting for /wm/learner"):
            bench.tick()
    assert [float(actions[0, 0]) for actions in bench.moved] == [0.5, 0.0]
    bench.refuse_credit(False)
    bench.tick()
    bench.refuse_credit(True)
    with pytest.raises(WireError, match="waiting for /wm/learner"):
        bench.tick()
    assert len(bench.moved) == 4, "each wait has its own hold"
    bench.refuse_credit(False)
    bench.tick()
    assert [step.episode_steps[0] for step in bench.published.transitions] == [0, 0, 1, 2]


def test_an_episode_that_ends_as_its_robot_holds_is_reset_in_the_next_step() -> None:
    bench = Bench(SOURCE_REAL)
    for _ in range(11):
        bench.tick()
    bench.refuse_credit(True)
    with pytest.raises(WireError, match="waiting for /wm/learner"):
        bench.tick()
    bench.refuse_credit(False)
    bench.tick()
    assert not bench.last.valid.any()
    bench.tick()
    assert bench.last.valid.all() and (bench.last.episode_steps == 0).all()


def test_an_episode_with_a_hold_that_reaches_its_last_step_has_met_the_time_limit() -> None:
    bench = Bench(SOURCE_REAL)
    bench.refuse_credit(True)
    with pytest.raises(WireError, match="waiting for /wm/learner"):
        bench.tick()
    bench.refuse_credit(False)
    for _ in range(11):
        bench.tick()
    ends = [note.reason for note in bench.published.notes if note.kind == EpisodeEvent.KIND_END]
    assert ends == [EpisodeEvent.REASON_TIME_LIMIT] * N


def test_a_simulator_that_waits_for_credit_stands_still(bench: Bench) -> None:
    bench.refuse_credit(True)
    with pytest.raises(WireError, match="waiting for /wm/learner"):
        bench.tick()
    assert not bench.moved
