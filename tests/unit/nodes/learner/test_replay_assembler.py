"""A replayed stream is cut into the rollouts that the bag's file holds; credit holds the player back."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("wm_msgs.msg", reason="wm_msgs is not built")

from recording_graph import NUM_ENVS, Graph, assert_same_rollout, write
from recording_samples import make_spec

from wm_nodes.core.lockstep import DroppedTransitions
from wm_nodes.core.types import Rollout
from wm_nodes.nodes.learner.rollout_assembler import MAX_KEPT, MAX_WAITING, RolloutAssembler
from wm_nodes.nodes.learner.rollout_sources import BagRollouts
from wm_nodes.policy_rl.training_run import Progress
from wm_nodes.recording import BagError, read_rollouts, topics
from wm_nodes.recording import messages as m
from wm_nodes.ros import convert

STEPS = 6
Keep = Callable[[topics.RecordedTopic, Any], bool]


def recorded(*lengths: int) -> Graph:
    """Rollouts of versions 1, 2, ..."""
    graph = Graph(make_spec(num_envs=NUM_ENVS))
    for version, steps in enumerate(lengths, start=1):
        graph.rollout(version, steps)
    graph.flush_rewards(10**9)
    return graph


def feed(assembler: RolloutAssembler, graph: Graph, keep: Keep = lambda topic, message: True) -> None:
    for topic, message, _ in graph.published:
        if not keep(topic, message):
            continue
        if topic is topics.IMAGES:
            assembler.put_image(m.time_ns(message.header.stamp), m.images_of(message, graph.spec))
        elif topic is topics.TRANSITION:
            assembler.put_transition(convert.transition_of(message, graph.spec))
        elif topic is topics.REWARD:
            assembler.put_rewards(convert.rewards_of(message))


def collecting(withheld: list[bool] | None = None) -> RolloutAssembler:
    assembler = RolloutAssembler((withheld if withheld is not None else []).append)
    assembler.begin(STEPS)
    return assembler


def taken(assembler: RolloutAssembler) -> Iterable[tuple[int, Rollout | None, DroppedTransitions]]:
    while (found := assembler.take_replayed(0.0)) is not None:
        yield found


def test_a_replayed_stream_gives_the_rollouts_that_the_file_gives(tmp_path: Path) -> None:
    graph = recorded(STEPS, STEPS, STEPS)
    assembler = collecting()
    feed(assembler, graph)
    assembler.finish()
    ours = list(taken(assembler))
    theirs = list(read_rollouts(write(tmp_path / "bag", graph), num_steps=STEPS))
    assert [version for version, _, _ in ours] == [1, 2, 3]
    for (_, rollout, _), other in zip(ours, theirs, strict=True):
        assert rollout is not None
        assert_same_rollout(rollout, other)


@pytest.mark.parametrize("topic", [topics.TRANSITION, topics.IMAGES, topics.REWARD])
def test_a_rollout_that_lost_a_message_is_given_up_and_counted(topic: topics.RecordedTopic) -> None:
    count = 0

    def keep(found: topics.RecordedTopic, message: Any) -> bool:
        nonlocal count
        count += found is topic
        return found is not topic or count != 4

    assembler = collecting()
    feed(assembler, recorded(STEPS, STEPS), keep)
    assembler.finish()
    (_, lost, dropped), (_, kept, _) = taken(assembler)
    assert lost is None
    assert dropped.gap == NUM_ENVS * (STEPS - (topic is topics.TRANSITION))
    assert kept is not None


def test_rollouts_of_another_length_are_left_out_as_the_file_does(tmp_path: Path) -> None:
    graph = recorded(STEPS - 1, STEPS, STEPS + 1)
    assembler = collecting()
    feed(assembler, graph)
    assembler.finish()
    assert [version for version, rollout, _ in taken(assembler) if rollout is not None] == [2]
    bags = BagRollouts([write(tmp_path / "bag", graph)], Progress(version=2), num_steps=STEPS, expected=None)
    found = bags.next()
    assert found is not None
    assert found[0].policy_version == 2
    assert bags.next() is None
    assert len(bags.left_out) == 2


def test_a_whole_rollout_ends_in_silence_and_an_unfinished_one_is_waited_for() -> None:
    assembler = collecting()
    feed(assembler, recorded(STEPS))
    assert assembler.take_replayed(60.0) is None
    found = assembler.take_replayed(0.0)
    assert found is not None
    assert found[1] is not None
    assembler = collecting()
    feed(assembler, recorded(STEPS - 1))
    assert assembler.take_replayed(0.0) is None


def test_credit_is_withheld_while_rollouts_wait_and_what_comes_nonetheless_is_counted() -> None:
    withheld: list[bool] = []
    assembler = collecting(withheld)
    feed(assembler, recorded(*[STEPS] * MAX_WAITING))
    assert True not in withheld
    assembler = collecting(withheld)
    feed(assembler, recorded(*[STEPS] * (MAX_KEPT + 3)))
    assert withheld[-1] is True
    assert assembler.waiting == MAX_KEPT
    first = assembler.take_replayed(0.0)
    assert first is not None
    assert first[2].gap == 3 * STEPS * NUM_ENVS
    for _ in taken(assembler):
        pass
    assert withheld[-1] is False


def test_nothing_is_kept_between_goals() -> None:
    assembler = RolloutAssembler(lambda withheld: None)
    feed(assembler, recorded(STEPS, STEPS))
    assembler.begin(STEPS)
    assembler.finish()
    assert assembler.take_replayed(0.0) is None


def test_a_bag_of_another_camera_is_refused(tmp_path: Path) -> None:
    graph = recorded(STEPS)
    expected = make_spec(num_envs=NUM_ENVS, cameras=("front", "overhead"))
    bags = BagRollouts([write(tmp_path / "bag", graph)], Progress(), num_steps=STEPS, expected=expected)
    with pytest.raises(BagError, match=r"cameras \('front', 'wrist'\), expected here is \('front', 'overhead'\)"):
        bags.next()
