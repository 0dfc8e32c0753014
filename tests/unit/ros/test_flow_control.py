"""Sequence numbers, credit, peers and the assembler, without DDS."""

import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("wm_msgs.msg", reason="wm_msgs is not built")

from rclpy.clock import Clock

from wm_msgs.msg import Credit
from wm_nodes.core.lockstep import Goals, LockStep, Rewards
from wm_nodes.core.processes import Activity
from wm_nodes.nodes.learner.rollout_assembler import RolloutAssembler
from wm_nodes.recording.join import KEPT, Joiner
from wm_nodes.ros.flow_control import SILENT_S, ConsumerCredits, ProducerCredits
from wm_nodes.ros.liveliness import PeerWatch
from wm_nodes.ros.sequence_numbers import BACK_RUN, GapTracker
from wm_nodes.ros.wire import PeerLost

N = 2


def test_gaps_are_counted_exactly_and_a_late_start_is_none() -> None:
    tracker = GapTracker()
    assert [tracker.observe(1, seq) for seq in (5, 6, 9, 9, 8, 10)] == [0, 0, 2, 0, 0, 0]
    assert tracker.lost == 2
    assert tracker.gaps == [(1, 7, 2)]


def test_a_session_that_began_while_listening_is_expected_from_its_first_message() -> None:
    tracker = GapTracker()
    assert [tracker.observe(2, 40), tracker.observe(3, 0), tracker.observe(4, 2), tracker.observe(4, 3)] == [0, 0, 2, 0]
    assert tracker.observe(1, 7) == 0, "it began before this consumer joined"
    assert (tracker.lost, tracker.gaps) == (2, [(4, 0, 2)])


def test_publishers_that_take_turns_lose_nothing_and_a_gap_in_one_of_them_is_counted_once() -> None:
    tracker = GapTracker()
    turns = [(1, 5), (2, 0), (1, 6), (2, 1), (1, 8), (2, 2)]
    assert [tracker.observe(*turn) for turn in turns] == [0, 0, 0, 0, 1, 0]
    assert (tracker.session, tracker.last_seq) == (2, 2)


def test_a_jump_beyond_every_buffer_is_no_loss_and_is_believed_only_where_the_next_message_goes_on() -> None:
    tracker = GapTracker()
    assert [tracker.observe(1, seq) for seq in (0, 1, 2**64 - 1, 2, 3, 2**40, 4, 6)] == [0, 0, 0, 0, 0, 0, 0, 1]
    assert (tracker.lost, tracker.jumps, tracker.last_seq) == (1, 2, 6)
    for session in range(2, 1000):
        tracker.observe(session, 2**63)
        tracker.observe(1, 5 + session)
    assert tracker.lost == 1 and len(tracker._last_seqs) <= 64
    assert [tracker.observe(1, 2**40 + more) for more in range(3)] == [0, 0, 0]
    assert (tracker.lost, tracker.last_seq) == (1, 2**40 + 2)


def test_an_old_message_after_a_jump_or_a_new_count_does_not_take_back_what_was_granted() -> None:
    tracker = GapTracker()
    for seq in (*range(98), 99, 2**63, 3):
        tracker.observe(1, seq)
    assert (tracker.last_seq, tracker.lost, tracker.gaps) == (99, 1, [(1, 98, 1)])
    tracker.clear_losses()
    tracker.observe(1, 3)
    assert (tracker.last_seq, tracker.lost, tracker.gaps) == (99, 0, [])


def test_the_producer_waits_for_every_consumer_and_drops_the_silent_one() -> None:
    ledger = ProducerCredits("env/transition", session=7)
    assert ledger.blocking_consumers(1000) == []
    for name, granted in (("fast", 20), ("slow", 10)):
        grant = Credit(consumer=name, topic="env/transition", stream_session=7, granted_seq=granted)
        ledger.note(grant, now=100.0)
    ledger.note(Credit(consumer="other", topic="reward", stream_session=7), now=100.0)
    ledger.note(Credit(consumer="old", topic="env/transition", stream_session=6), now=100.0)
    assert ledger.blocking_consumers(10) == []
    assert ledger.blocking_consumers(11) == ["slow"]
    assert ledger.drop_silent(11, now=100.0 + SILENT_S) == []
    assert ledger.drop_silent(11, now=100.1 + SILENT_S) == ["slow"]
    assert ledger.blocking_consumers(20) == []


def test_a_worker_may_ask_who_blocks_while_the_executor_takes_in_credits() -> None:
    ledger, ended, failed = ProducerCredits("env/transition", session=7), threading.Event(), list[Exception]()
    for number in range(60):
        ledger.note(Credit(consumer=f"{number}", topic="env/transition", stream_session=7))

    def ask() -> None:
        try:
            while not ended.is_set():
                ledger.blocking_consumers(1)
                ledger.drop_silent(1, now=0.0)
                assert ledger.consumers
        except Exception as error:
            failed.append(error)

    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    worker = threading.Thread(target=ask)
    worker.start()
    try:
        for number in range(20_000):
            ledger.note(Credit(consumer=f"{number % 70}", topic="env/transition", stream_session=7))
            ledger.remove(f"{number * 7 % 70}")
    finally:
        ended.set()
        worker.join()
        sys.setswitchinterval(interval_s)
    assert not failed


class GrantingNode:
    """What a ConsumerCredits asks of a node."""

    def __init__(self) -> None:
        self.sent: list[Credit] = []
        self.publish = self.sent.append

    def create_publisher(self, *arguments: object) -> "GrantingNode":
        return self

    def create_timer(self, *arguments: object, **named: object) -> None: ...

    def get_fully_qualified_name(self) -> str:
        return "/wm/learner"

    def get_clock(self) -> Clock:
        return Clock()


def test_a_withheld_grant_is_repeated_but_does_not_grow_until_it_is_given_again() -> None:
    node = GrantingNode()
    grantor, tracker = ConsumerCredits(node, "env/transition", window=8), GapTracker()  # type: ignore[arg-type]

    def consume(session: int, *seqs: int) -> None:
        for seq in seqs:
            tracker.observe(session, seq)
            grantor.record_consumed(tracker)

    consume(1, 0)
    grantor.withhold(True)
    consume(1, 1, 2, 3, 4)
    assert {credit.granted_seq for credit in node.sent} == {8}
    assert node.sent[-1].received_seq == 4
    consume(2, 0, 1)
    assert (node.sent[-1].stream_session, node.sent[-1].granted_seq) == (2, 9)
    consume(2, 2, 3)
    assert node.sent[-1].granted_seq == 9
    grantor.withhold(False)
    assert node.sent[-1].granted_seq == 11


def test_stray_old_messages_take_back_no_grant() -> None:
    node = GrantingNode()
    grantor, tracker = ConsumerCredits(node, "env/transition"), GapTracker()  # type: ignore[arg-type]
    stray = (*range(BACK_RUN - 1), 40, 41, *range(BACK_RUN - 1), 100, BACK_RUN - 1, 101, BACK_RUN, 102)
    for seq in (*range(100), *stray):
        tracker.observe(1, seq)
        grantor.record_consumed(tracker)
    assert tracker.last_seq == 102 and node.sent[-1].granted_seq > 99


@pytest.mark.parametrize("goes_on_at", [0, 30])
def test_a_replay_that_begins_again_is_held_where_the_first_one_was(goes_on_at: int) -> None:
    node = GrantingNode()
    grantor, tracker, held_at = ConsumerCredits(node, "env/transition"), GapTracker(), list[int]()  # type: ignore[arg-type]
    for start in (0, goes_on_at):
        grantor.withhold(False)
        for seq in range(start, 200):
            tracker.observe(1, seq)
            grantor.record_consumed(tracker)
            grantor.withhold(seq >= 50)
            if seq == node.sent[-1].granted_seq:
                held_at.append(seq)
                break
        else:
            pytest.fail("never held")
    assert all(50 + 16 - 16 // 4 <= seq <= 50 + 16 for seq in held_at)  # grants are a quarter window apart


def test_a_replay_that_begins_again_while_credit_is_withheld_is_held_after_one_window() -> None:
    node = GrantingNode()
    grantor, tracker = ConsumerCredits(node, "env/transition"), GapTracker()  # type: ignore[arg-type]
    for seq in (*range(50), *range(12)):
        grantor.withhold(seq == 49 or grantor.withheld)
        tracker.observe(1, seq)
        grantor.record_consumed(tracker)
    assert node.sent[-1].granted_seq < 30 and tracker.lost == 0


def test_a_silent_peer_is_lost_once_and_a_leaving_one_is_not() -> None:
    peers = PeerWatch("/wm/me", timeout_s=3.0)
    for name in ("/wm/me", "/wm/a", "/wm/b"):
        peers.heard(name, now=0.0)
    peers.left("/wm/b")
    assert peers.check(now=3.0) == []
    assert peers.check(now=3.1) == ["/wm/a"]
    assert peers.check(now=4.0) == []
    assert peers.is_lost("/wm/a")
    assert [peers.silence_s(name, now=4.5) for name in ("/wm/a", "/wm/b", "/wm/never")] == [4.5, 0.0, 0.0]
    peers.heard("/wm/a", now=5.0)
    assert peers.lost == [] and peers.silence_s("/wm/a", now=5.5) == 0.5


def test_a_peer_that_computes_is_lost_only_after_five_times_as_long() -> None:
    seen = {"busy": Activity.BUSY, "stopped": Activity.STOPPED, "gone": Activity.GONE, "elsewhere": None}
    peers = PeerWatch("/wm/me", timeout_s=3.0, activity=lambda identity: seen[identity])
    for name in seen:
        peers.heard(f"/wm/{name}", now=0.0, identity=name)
    lost = {now: fresh for now in range(40) if (fresh := peers.check(now=now / 2))}
    assert lost == {7: ["/wm/elsewhere", "/wm/gone", "/wm/stopped"], 31: ["/wm/busy"]}


def test_time_in_which_a_process_stood_still_makes_no_peer_lost() -> None:
    peers = PeerWatch("/wm/me", timeout_s=3.0)
    peers.heard("/wm/a", now=0.0)
    assert peers.check(now=0.5) == []
    assert peers.check(now=20.5) == [], "it was this process that slept for 20 s"
    assert [peers.check(now=20.5 + 0.5 * k) for k in range(1, 4)] == [[], [], ["/wm/a"]], "1 s in which it is awake"


def test_a_peer_whose_death_holds_this_process_up_is_reported_in_time() -> None:
    peers = PeerWatch("/wm/me", timeout_s=3.0)
    peers.check(now=0.0)
    peers.heard("/wm/dead", now=0.1)
    peers.heard("/wm/alive", now=0.1)
    assert peers.check(now=2.5) == [], "the middleware held the process for 2.5 s"
    peers.heard("/wm/alive", now=2.5)
    assert [peers.check(now=2.5 + 0.5 * k) for k in range(1, 4)] == [[], [], ["/wm/dead"]]


def test_a_process_that_is_always_late_still_finds_out_who_is_lost() -> None:
    peers = PeerWatch("/wm/me", timeout_s=3.0)
    peers.heard("/wm/a", now=0.0)
    assert [now for now in range(0, 30, 2) if peers.check(now=float(now))] == [8]


def test_of_what_no_lockstep_waits_for_only_the_newest_is_kept() -> None:
    joiner = Joiner(with_rewards=True)
    for step_id in range(KEPT + 2):
        joiner.put_image(10 * step_id, images(1))
        joiner.put_rewards(rewards(step_id))
    assert (len(joiner._images), len(joiner._rewards)) == (KEPT, KEPT)
    joiner.put_step(step(KEPT))
    assert [joined.step_id for joined in joiner.take()] == [KEPT]
    assert list(joiner._images) == [10 * KEPT, 10 * (KEPT + 1)]


def test_locksteps_leave_in_order_when_they_are_complete_or_too_late() -> None:
    joiner = Joiner(with_rewards=True)
    for step_id in (1, 2, 3):
        joiner.put_step(step(step_id))
        joiner.put_rewards(rewards(step_id))
    assert list(joiner.take(patience_s=60)) == []
    for step_id in (1, 3, 4):
        joiner.put_image(10 * step_id, images(step_id))
    assert [joined.step_id for joined in joiner.take(max_behind=2)] == [1]
    assert [(joined.step_id, joined.images is None) for joined in joiner.take(max_behind=1)] == [(2, True), (3, False)]


def waiting(joiner: Joiner, last: int) -> Joiner:
    """The reset lock-step 0 and lock-steps 1 to `last`, with images and without rewards."""
    joiner.put_image(10, images(1))
    joiner.put_step(replace(step(0, valid=False), stamp_ns=10, next_stamp_ns=10))
    for step_id in range(1, last + 1):
        joiner.put_image(10 * (step_id + 1), images(step_id % 256))
        joiner.put_step(step(step_id))
    return joiner


def test_rewards_that_come_after_a_whole_rollout_are_waited_for() -> None:
    joiner = waiting(Joiner(with_rewards=True), 120)
    assert [joined.step_id for joined in joiner.take(max_behind=64)] == [0]
    found = list[LockStep]()
    for step_id in range(1, 121):
        joiner.put_rewards(rewards(step_id))
        found += joiner.take(max_behind=64)
    assert [joined.rewards.total[0] for joined in found if joined.rewards] == list(range(1, 121))
    assert all(joined.images is not None for joined in found)


def test_rewards_from_before_a_reset_are_waited_for_a_little_after_it() -> None:
    joiner = waiting(Joiner(with_rewards=True), 5)
    assert len(list(joiner.take(max_behind=4))) == 1
    joiner.put_step(replace(step(5, valid=False), stamp_ns=60, next_stamp_ns=60))
    for step_id in (6, 7, 8):
        joiner.put_image(10 * (step_id + 1), images(step_id))
        joiner.put_step(step(step_id))
    joiner.put_rewards(rewards(1))
    assert [joined.rewards is not None for joined in joiner.take(max_behind=4)] == [True]
    joiner.put_step(step(9))
    given = [(joined.step_id, joined.rewards is not None) for joined in joiner.take(max_behind=4)]
    assert given == [(2, False), (3, False), (4, False), (5, False), (5, False)]


def test_rewards_that_were_lost_hold_nothing_back_where_later_ones_come_or_none_do() -> None:
    joiner = waiting(Joiner(with_rewards=True), 6)
    assert len(list(joiner.take(max_behind=4))) == 1
    for step_id in (2, 3):
        joiner.put_rewards(rewards(step_id))
    given = [(joined.step_id, joined.rewards is not None) for joined in joiner.take(max_behind=4)]
    assert given == [(1, False), (2, True), (3, True)]
    assert list(joiner.take(max_behind=4)) == []
    joiner.end_rewards()
    assert [joined.step_id for joined in joiner.take(max_behind=4)] == [4, 5, 6]


def test_goals_are_waited_for_until_it_is_clear_that_nobody_publishes_them() -> None:
    joiner = Joiner(with_goals=True)
    for step_id in (1, 2, 3):
        joiner.put_image(10 * step_id, images(step_id))
    joiner.put_step(step(1))
    assert list(joiner.take(patience_s=60)) == []
    assert [joined.goals for joined in joiner.take(patience_s=0)] == [None]
    joiner.put_step(step(2))
    assert len(list(joiner.take(patience_s=60))) == 1
    joiner.clear()
    joiner.put_step(step(1))
    for stamp in (10, 20):
        joiner.put_image(stamp, images(1))
    joiner.put_goals(Goals(10, images(9), np.array([True, False]), np.zeros(N, np.uint64), session=2))
    assert list(joiner.take(patience_s=60)) == [], "of another session"
    joiner.put_goals(Goals(10, images(9), np.array([True, True]), np.zeros(N, np.uint64), session=1))
    (joined,) = joiner.take(patience_s=60)
    assert joined.goals is not None and (joined.goals[0] == 9).all() and joined.goals[1].all()


def step(step_id: int, *, version: int = 3, valid: bool = True, session: int = 1) -> LockStep:
    zeros, flags = np.zeros(N, np.float32), np.zeros(N, bool)
    return LockStep(
        stamp_ns=10 * step_id, next_stamp_ns=10 * (step_id + 1), step_id=step_id, actions=np.zeros((N, 3), np.float32),
        states=np.full((N, 3), step_id, np.float32), next_states=np.full((N, 3), step_id + 1, np.float32),
        logprobs=zeros, values=zeros, terminated=flags, truncated=flags, valid=np.full(N, valid),
        episode_ids=np.zeros(N, np.uint64), episode_steps=np.zeros(N, np.uint32),
        policy_versions=np.full(N, version, np.uint64), success_probability=zeros, uncertainty=zeros,
        ground_truth=np.zeros((N, 0), np.float32), source=0, session=session,
    )


def rewards(step_id: int, valid: bool = True) -> Rewards:
    total = np.full(N, step_id, np.float32)
    return Rewards(
        session=1, step_id=step_id, stamp_ns=10 * step_id, total=total, dense=total, sparse=total,
        components=total[:, None], component_names=("total",), success=np.zeros(N, np.uint8),
        valid=np.array([valid, True]), invalid_reason="", name="rule", version=1,
    )


def images(value: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.full((N, 2, 2, 3), value, np.uint8)


def full_assembler(left_out: tuple[str, int] = ("", 0)) -> RolloutAssembler:
    assembler = RolloutAssembler()
    assembler.begin()
    for step_id in (1, 2, 3):
        if left_out != ("transition", step_id):
            assembler.put_transition(step(step_id))
        if left_out != ("reward", step_id):
            assembler.put_rewards(rewards(step_id))
    for step_id in (1, 2, 3, 4):
        if left_out != ("image", step_id):
            assembler.put_image(10 * step_id, images(step_id))
    return assembler


def test_a_rollout_whose_environment_was_restarted_before_it_was_taken_is_made_again() -> None:
    assembler = full_assembler()
    assembler.enter_session(2)
    with pytest.raises(PeerLost, match="restarted"):
        assembler.take(1, 1, 3, policy_version=3)


def test_an_environment_that_restarts_while_a_rollout_is_taken_does_not_tear_it(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    assembler = full_assembler()
    restart, missing = threading.Thread(target=assembler.enter_session, args=(2,)), assembler.missing

    def missing_before_the_restart(*span: int) -> list[int]:
        found = missing(*span)
        restart.start()
        restart.join(0.2)
        return found

    monkeypatch.setattr(assembler, "missing", missing_before_the_restart)
    rollout, _ = assembler.take(1, 1, 3, policy_version=3)
    assert rollout.valid_TN.all()
    restart.join()


def test_a_complete_rollout_is_joined_by_stamp_and_step_id() -> None:
    assembler = full_assembler()
    assert assembler.missing(1, 1, 3) == []
    assert assembler.missing(2, 1, 3) == [1, 2, 3]
    rollout, dropped = assembler.take(1, 1, 3, policy_version=3)
    assert rollout.images_TN[:, 0, 0, 0, 0].tolist() == [1, 2, 3]
    assert rollout.next_images_TN[:, 0, 0, 0, 0].tolist() == [2, 3, 4]
    assert rollout.rewards_TN[:, 0].tolist() == [1, 2, 3]
    assert rollout.valid_TN.all()
    assert (dropped.invalid, dropped.gap, dropped.stale) == (0, 0, 0)


@pytest.mark.parametrize(
    ("left_out", "missing"), [(("transition", 2), [2]), (("reward", 3), [3]), (("image", 2), [1, 2])]
)
def test_what_is_missing_is_invalid_and_counted_never_zero(left_out: tuple[str, int], missing: list[int]) -> None:
    assembler = full_assembler(left_out)
    assert assembler.missing(1, 1, 3) == missing
    rollout, dropped = assembler.take(1, 1, 3, policy_version=3)
    assert [t + 1 for t in range(3) if not rollout.valid_TN[t].any()] == missing
    assert dropped.gap == N * len(missing)


def test_invalid_rewards_and_other_versions_are_left_out_by_reason() -> None:
    assembler = full_assembler(("reward", 2))
    assembler.put_rewards(rewards(2, valid=False))
    assembler.put_rewards(rewards(2))  # the first ones count
    assembler.put_transition(step(3, version=2))
    rollout, dropped = assembler.take(1, 1, 3, policy_version=3)
    assert rollout.valid_TN.tolist() == [[True, True], [False, True], [False, False]]
    assert (dropped.invalid, dropped.gap, dropped.stale) == (1, 0, 2)


def test_a_new_session_makes_everything_before_worthless() -> None:
    assembler = full_assembler()
    assembler.put_transition(step(1, session=2))
    assert assembler.missing(2, 1, 1) == [1]
    assert assembler.missing(1, 1, 3) == [1, 2, 3]
