"""Recordings of a live graph: several environments in one mosaic, rewards that lag, resets, losses, restarts."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recording_graph import NUM_ENVS, PERIOD_NS, Graph, assert_same_rollout, write
from recording_samples import make_spec

from wm_nodes.recording import Bag, BagError, BagReport, read_episodes, read_rollouts, read_spec, topics
from wm_nodes.recording import messages as m
from wm_nodes.recording.join import MAX_LAG, LockSteps
from wm_nodes.recording.layout import Tiles


@pytest.fixture
def graph() -> Graph:
    return Graph(make_spec(num_envs=NUM_ENVS))


def test_rollouts_equal_what_the_graph_published(tmp_path: Path, graph: Graph) -> None:
    graph.rollout(1, 6)
    graph.rollout(2, 5)
    graph.rollout(3, 6, reset=False)
    found = list(read_rollouts(write(tmp_path / "bag", graph)))
    assert [rollout.policy_version for rollout in found] == [1, 2, 3]
    for ours, theirs in zip(found, graph.rollouts, strict=True):
        assert_same_rollout(ours, theirs)


def test_stamps_of_wall_time_give_the_same_rollouts_and_episodes_as_stamps_that_count(
    tmp_path: Path, graph: Graph
) -> None:
    timed = Graph(graph.spec, start_ns=1_764_000_000 * m.NS_PER_S)
    for each in (graph, timed):
        each.rollout(1, 8)
    paths = write(tmp_path / "counted", graph), write(tmp_path / "timed", timed)
    for ours, theirs in zip(*map(read_rollouts, paths), strict=True):
        assert_same_rollout(ours, theirs)
    for episode, same in zip(*map(read_episodes, paths), strict=True):
        np.testing.assert_array_equal(episode.images, same.images)
        np.testing.assert_array_equal(episode.ground_truth, same.ground_truth)


def test_rewards_a_whole_rollout_late_still_join(tmp_path: Path, graph: Graph) -> None:
    graph.reward_lag = 40
    graph.rollout(1, 50)
    (found,) = read_rollouts(write(tmp_path / "bag", graph))
    assert_same_rollout(found, graph.rollouts[0])


def test_rewards_that_come_at_the_end_of_long_rollouts_still_join(tmp_path: Path, graph: Graph) -> None:
    prompt = Graph(graph.spec)
    graph.reward_lag = 10**6
    for each in (graph, prompt):
        for version in (1, 2):
            each.rollout(version, 120)
            each.flush_rewards(10**9)
    path = write(tmp_path / "bag", graph)
    for ours, theirs in zip(read_rollouts(path, num_steps=120), graph.rollouts, strict=True):
        assert_same_rollout(ours, theirs)
    episodes, same = list(read_episodes(path)), list(read_episodes(write(tmp_path / "prompt", prompt)))
    assert sum(episode.num_steps for episode in episodes) > 400
    for episode, expected in zip(episodes, same, strict=True):
        np.testing.assert_array_equal(episode.rewards, expected.rewards)


@pytest.mark.parametrize("lost", [lambda step_id: step_id == 5, lambda step_id: step_id > 5])
def test_lost_rewards_hold_no_more_lock_steps_back_than_other_losses(
    tmp_path: Path, graph: Graph, lost: Callable[[int], bool]
) -> None:
    graph.rollout(1, 300)
    path = write(tmp_path / "bag", graph, drop=lambda topic, x: topic is topics.REWARD and lost(x.step_id))
    with Bag(path) as bag:
        steps = LockSteps(bag)
        taken = [(step, len(steps._joiner._waiting)) for step in steps]
    assert len(taken) == 301
    for step, num_waiting in taken:
        assert (step.rewards is None) == (lost(step.step_id) or not step.valid.any())
        assert num_waiting <= MAX_LAG


def test_live_episodes_carry_frame_zero_truth_and_the_events_labels(tmp_path: Path, graph: Graph) -> None:
    graph.rollout(4, 8)
    path = write(tmp_path / "bag", graph)
    episodes = {episode.episode_id: episode for episode in read_episodes(path)}
    assert read_spec(path) == graph.spec
    assert sorted(episode.num_steps for episode in episodes.values()) == [2, 2, 2, 3, 3, 4]
    rollout, first = graph.rollouts[0], episodes[2]
    np.testing.assert_array_equal(first.images[:3], rollout.images_TN[:3, 1])
    np.testing.assert_array_equal(first.images[3], rollout.next_images_TN[2, 1])
    np.testing.assert_array_equal(first.actions, rollout.actions_TN[:3, 1])
    expected = np.where(rollout.valid_TN[:3, 1], rollout.rewards_TN[:3, 1], np.nan)
    np.testing.assert_array_equal(first.rewards, expected)
    assert (first.seed, first.behaviour, first.instruction, first.policy_version) == (502, "policy", "push", 4)
    assert first.truncated
    assert first.extra["env_index"] == 1
    assert first.extra["termination_reason"] == m.REASON_TIME_LIMIT
    for episode in episodes.values():
        assert np.isfinite(episode.ground_truth).all()


def test_episodes_cut_off_by_the_recording_are_counted_not_invented(tmp_path: Path, graph: Graph) -> None:
    graph.rollout(1, 9)
    late = Graph(graph.spec)
    late.published = [item for item in graph.published if item[0] is topics.SPEC or m.stamp_ns(
        item[1].header.stamp) > 2 * PERIOD_NS]
    report = BagReport()
    found = list(read_episodes(write(tmp_path / "bag", late), report=report))
    assert report.yielded == len(found)
    assert report.unfinished > 0
    assert not report.incomplete


def test_a_lost_image_is_an_error_or_a_counted_loss(tmp_path: Path, graph: Graph) -> None:
    graph.rollout(1, 8)
    graph.rollout(2, 8)
    lost = 4 * PERIOD_NS
    path = write(tmp_path / "bag", graph, drop=lambda t, x: t is topics.IMAGES and m.stamp_ns(x.header.stamp) == lost)
    with pytest.raises(BagError, match=r"image at stamp 400000000 is missing.*report=BagReport\(\)"):
        list(read_episodes(path))
    with pytest.raises(BagError, match=r"rollout of policy_version 1 .*an image of step_id 3 is missing"):
        list(read_rollouts(path))
    report = BagReport()
    (found,) = read_rollouts(path, report=report)
    assert_same_rollout(found, graph.rollouts[1])
    assert len(report.incomplete) == 1


def test_a_lost_transition_is_an_error_or_a_counted_loss(tmp_path: Path, graph: Graph) -> None:
    graph.rollout(1, 8)
    graph.rollout(2, 8)
    path = write(tmp_path / "bag", graph, drop=lambda t, x: t is topics.TRANSITION and x.seq == 3)
    report = BagReport()
    (found,) = read_rollouts(path, report=report)
    assert_same_rollout(found, graph.rollouts[1])
    assert report.lost_steps == 1
    with pytest.raises(BagError, match="step_id 3 is missing"):
        list(read_rollouts(path))
    with pytest.raises(BagError, match=r"step \d is missing"):
        list(read_episodes(path))


def test_a_lost_reward_leaves_out_the_rollout_but_keeps_the_episodes(tmp_path: Path, graph: Graph) -> None:
    graph.rollout(1, 8)
    path = write(tmp_path / "bag", graph, drop=lambda t, x: t is topics.REWARD and x.step_id == 2)
    with pytest.raises(BagError, match="the reward of step_id 2 is missing"):
        list(read_rollouts(path))
    report = BagReport()
    episodes = {episode.episode_id: episode for episode in read_episodes(path, report=report)}
    assert np.isnan(episodes[1].rewards[1])
    assert report.missing_rewards > 0
    assert not report.incomplete


@pytest.mark.parametrize("start_ns", [1_000 * m.NS_PER_S, 2_000 * m.NS_PER_S])
def test_the_images_before_and_after_a_restart_are_not_mixed_whichever_stamps_are_later(
    tmp_path: Path, start_ns: int
) -> None:
    graph = Graph(make_spec(num_envs=NUM_ENVS), start_ns=1_500 * m.NS_PER_S)
    graph.rollout(1, 3)
    again = Graph(graph.spec, session=8, start_ns=start_ns)
    again.rollout(1, 9)
    found = list(read_rollouts(write(tmp_path / "bag", graph, again)))
    for ours, theirs in zip(found, graph.rollouts + again.rollouts, strict=True):
        assert_same_rollout(ours, theirs)


def test_rollouts_of_another_length_are_refused_when_one_is_asked_for(tmp_path: Path, graph: Graph) -> None:
    graph.rollout(1, 6)
    path = write(tmp_path / "bag", graph)
    assert len(list(read_rollouts(path, num_steps=6))) == 1
    with pytest.raises(BagError, match="6 lock-steps instead of 7"):
        list(read_rollouts(path, num_steps=7))


def test_images_that_do_not_fit_the_recorded_spec_are_refused(tmp_path: Path, graph: Graph) -> None:
    graph.rollout(1, 3)
    for topic, message, _ in graph.published:
        if topic is topics.IMAGES:
            message.encoding = "bgr8"
    with pytest.raises(BagError, match=r"encoding is 'bgr8', not 'rgb8'.*another robot, camera"):
        list(read_episodes(write(tmp_path / "bag", graph)))
    other = Graph(replace(graph.spec, width=20))
    other.rollout(1, 3)
    other.published[0] = (topics.SPEC, m.spec_message(graph.spec, 0, 7), 1)
    with pytest.raises(BagError, match="width is 40, not 24; step is 120, not 72"):
        list(read_episodes(write(tmp_path / "other", other)))


def test_a_bag_without_spec_images_or_rewards_says_what_to_record(tmp_path: Path, graph: Graph) -> None:
    graph.rollout(1, 3)
    cases = {topics.SPEC: "no message on /wm/env/spec", topics.IMAGES: "no images on /wm/env/image"}
    for number, (missing, text) in enumerate(cases.items()):
        path = write(tmp_path / str(number), graph, drop=lambda t, _, missing=missing: t is missing)
        with pytest.raises(BagError, match=text):
            list(read_episodes(path))
    path = write(tmp_path / "unrewarded", graph, drop=lambda t, _: t is topics.REWARD)
    with pytest.raises(BagError, match="no rewards; record the topic reward"):
        list(read_rollouts(path))
    assert all(np.isnan(episode.rewards).all() for episode in read_episodes(path))


@pytest.mark.parametrize(("count", "shape"), [(1, (1, 1)), (2, (1, 2)), (3, (2, 2)), (16, (4, 4)), (17, (4, 5))])
def test_tiles_put_environment_i_at_row_i_div_cols(count: int, shape: tuple[int, int]) -> None:
    tiles = Tiles.of(count, 4, 6)
    assert (tiles.rows, tiles.cols) == shape
    images = np.random.default_rng(0).integers(0, 256, (count, 4, 6, 3), dtype=np.uint8)
    mosaic = tiles.tile(images)
    row, col = (count - 1) // tiles.cols, (count - 1) % tiles.cols
    np.testing.assert_array_equal(mosaic[row * 4 : row * 4 + 4, col * 6 : col * 6 + 6], images[-1])
    np.testing.assert_array_equal(tiles.untile(mosaic, count), images)
