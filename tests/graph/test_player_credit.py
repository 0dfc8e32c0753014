"""The player and the credit of its consumers, over DDS."""

import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from graph.test_recorder_player import Listener, Start, live_graph, peer, recorded, replay
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from recording_graph import write
from std_srvs.srv import Trigger

from wm_msgs.msg import Credit, TransitionBatch
from wm_msgs.srv import PlayNext, Seek
from wm_nodes.recording import Bag
from wm_nodes.ros import qos as table

__all__ = ["peer"]

pytestmark = pytest.mark.graph


def test_single_messages_are_played_to_a_consumer_with_credit_without_a_wait_and_without_a_gap(
    domain: int, tmp_path: Path, peer: Start
) -> None:
    path = write(tmp_path / "bag", live_graph(60))
    player = peer(domain, "player_node", tmp_path, start_paused=True)
    listener, row = Listener(player, path), table.topic("flow/credit")
    credits = player.node.create_publisher(Credit, row.name, row.qos)

    def grant(message: TransitionBatch) -> None:
        credits.publish(Credit(
            consumer="/wm/peer", topic="env/transition", stream_session=message.session, received_seq=message.seq,
            granted_seq=message.seq + 16,
        ))

    transition = table.topic("env/transition")
    player.node.create_subscription(TransitionBatch, "env/transition", grant, transition.qos)
    replay(player, feedback := list[Any](), bag_uri="bag", rate=1.0)
    player.wait(lambda: feedback, "feedback")
    total, short_s = sum(map(len, recorded(path).values())) - 5, list[float]()
    told = [player.call(PlayNext, "player/play_next", num_messages=20).played]
    player.wait(lambda: len(listener.order) == 20, "the first messages, for which credit is granted")
    while sum(told) < total:
        began, asked = time.monotonic(), min(200, total - sum(told))
        told.append(player.call(PlayNext, "player/play_next", num_messages=asked).played)
        if told[-1] < asked:
            short_s.append(time.monotonic() - began)
        assert len(told) < 60, told
    assert short_s, "credit was waited for"
    assert min(short_s) < 2.0, "the executor, which brings the credit, did not wait for it"
    player.wait(lambda: len(listener.order) == total, "every message")


def test_a_seek_beyond_what_was_granted_goes_on_as_a_new_pass_does(domain: int, tmp_path: Path, peer: Start) -> None:
    path = write(tmp_path / "bag", live_graph(60))
    player = peer(domain, "player_node", tmp_path, start_paused=True)
    row, seqs = table.topic("flow/credit"), list[int]()
    credits, transition = player.node.create_publisher(Credit, row.name, row.qos), table.topic("env/transition")

    def grant(message: TransitionBatch) -> None:
        seqs.append(message.seq)
        credits.publish(Credit(
            consumer="/wm/peer", topic="env/transition", stream_session=message.session, granted_seq=message.seq + 16,
        ))

    player.node.create_subscription(TransitionBatch, "env/transition", grant, transition.qos)
    replay(player, feedback := list[Any](), bag_uri="bag", rate=1.0, topics=["env/transition"])
    player.wait(lambda: feedback, "feedback")
    assert player.call(PlayNext, "player/play_next", num_messages=3).played == 3
    player.wait(lambda: seqs == [0, 1, 2], "three transitions")
    with Bag(path) as bag:
        length_s = (bag.end_ns - bag.start_ns) / 1e9
    assert player.call(Seek, "player/seek", position=0.8 * length_s).error_code == 0
    player.call(PlayNext, "player/play_next", num_messages=3)
    player.wait(lambda: len(seqs) == 6, "three further transitions")
    assert seqs[3] > 2 + 16


def test_a_player_that_is_deactivated_while_it_waits_for_credit_plays_again_when_activated(
    domain: int, tmp_path: Path, peer: Start
) -> None:
    write(tmp_path / "bag", live_graph(100))
    row, seqs, granted = table.topic("flow/credit"), list[int](), [5]
    player = peer(domain, "player_node", tmp_path, bag_uri="bag", rate=5.0, start_paused=True)
    credits, transition = player.node.create_publisher(Credit, row.name, row.qos), table.topic("env/transition")
    session = list[int]()

    def grant() -> None:
        if session:
            credits.publish(Credit(
                consumer="/wm/peer", topic="env/transition", stream_session=session[-1], granted_seq=granted[-1],
            ))

    def take(message: TransitionBatch) -> None:
        seqs.append(message.seq)
        session.append(message.session)
        grant()

    player.node.create_subscription(TransitionBatch, "env/transition", take, transition.qos)
    player.node.create_timer(0.2, grant)
    assert player.call(Trigger, "player/resume").success
    player.wait(lambda: seqs, "transitions")
    player.match()
    assert (held := len(seqs)) < 100, "it was not held"
    ask = partial(player.call, ChangeState, "player/change_state")
    assert ask(transition=Transition(id=Transition.TRANSITION_DEACTIVATE)).success
    player.match()
    assert len(seqs) == held, "it went on without credit"
    assert ask(transition=Transition(id=Transition.TRANSITION_ACTIVATE)).success
    granted.append(1000)
    seqs.clear()
    assert player.call(Trigger, "player/resume").success
    player.wait(lambda: 100 in seqs, "the last transition")
