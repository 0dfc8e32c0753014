"""Whole episodes through a bag and back."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from recording_samples import assert_same_episode, make_episode, make_spec

from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import Episode
from wm_nodes.recording import (
    Bag,
    BagError,
    BagReport,
    EpisodeBagWriter,
    read_episodes,
    read_spec,
)


def write_bag(path: Path, spec: EnvironmentSpec, episodes: list[Episode], **options: object) -> Path:
    with EpisodeBagWriter(path, spec, run_id="test", **options) as writer:  # type: ignore[arg-type]
        for episode in episodes:
            writer.write(episode)
    return path


def test_episodes_come_back_bit_equal_and_in_order(tmp_path: Path) -> None:
    spec = make_spec(num_envs=16)
    episodes = [make_episode(spec, index, steps=3 + index) for index in range(5)]
    path = write_bag(tmp_path / "bag", spec, episodes)
    found = list(read_episodes(path))
    assert len(found) == 5
    for ours, theirs in zip(found, episodes):
        assert_same_episode(ours, theirs)
    assert read_spec(path) == replace(spec, num_envs=1)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_shape_survives_the_round_trip(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    sizes = st.integers(1, 9)
    actions, states, truth = data.draw(sizes), data.draw(sizes), data.draw(st.integers(0, 5))
    spec = make_spec(
        height=data.draw(sizes),
        width=data.draw(sizes),
        action_names=tuple(f"a{i}" for i in range(actions)),
        action_units=("m",) * actions,
        action_scale=tuple(data.draw(st.lists(st.floats(0.001, 10), min_size=actions, max_size=actions))),
        state_names=tuple(f"s{i}" for i in range(states)),
        state_units=("rad",) * states,
        state_low=(),
        state_high=(),
        ground_truth_names=tuple(f"p{i}" for i in range(truth)),
        control_period_s=1 / data.draw(st.integers(1, 60)),
        instruction=data.draw(st.text(max_size=20).filter(lambda text: "\0" not in text)),
    )
    lengths = data.draw(st.lists(st.integers(1, 6), min_size=1, max_size=4))
    episodes = [make_episode(spec, index, steps) for index, steps in enumerate(lengths)]
    path = write_bag(tmp_path_factory.mktemp("shapes") / "bag", spec, episodes)
    for ours, theirs in zip(read_episodes(path, expected=spec), episodes, strict=True):
        assert_same_episode(ours, theirs)
    assert read_spec(path).spec_hash == replace(spec, num_envs=1).spec_hash


def test_missing_rewards_and_unknown_truth_stay_missing(tmp_path: Path) -> None:
    spec = make_spec()
    episode = make_episode(spec)
    episode.rewards[1:3] = np.nan
    episode.ground_truth[:] = np.nan
    path = write_bag(tmp_path / "bag", spec, [episode])
    report = BagReport()
    (found,) = read_episodes(path, report=report)
    assert_same_episode(found, episode)
    assert report == BagReport(yielded=1, missing_rewards=2)


def test_truth_of_the_first_frame_is_in_the_bag(tmp_path: Path) -> None:
    spec = make_spec()
    episodes = [make_episode(spec, index) for index in range(3)]
    for found, episode in zip(read_episodes(write_bag(tmp_path / "bag", spec, episodes)), episodes, strict=True):
        np.testing.assert_array_equal(found.ground_truth[0], episode.ground_truth[0])
        assert found.success[0] == episode.success[0]


def test_a_large_bag_is_split_into_files_and_read_as_one(tmp_path: Path) -> None:
    spec = make_spec()
    episodes = [make_episode(spec, index) for index in range(12)]
    path = write_bag(tmp_path / "bag", spec, episodes, split_bytes=5000)
    assert len(list(path.glob("*.mcap"))) > 2
    for found, episode in zip(read_episodes(path), episodes, strict=True):
        assert_same_episode(found, episode)


def test_behaviours_filter_keeps_only_the_named_ones(tmp_path: Path) -> None:
    spec = make_spec()
    path = write_bag(tmp_path / "bag", spec, [make_episode(spec, index) for index in range(6)])
    assert [episode.episode_id for episode in read_episodes(path, behaviours={"noisy", "expert"})] == [0, 1, 3, 4]


def test_custom_data_hold_run_spec_and_episode_table(tmp_path: Path) -> None:
    spec = make_spec()
    episodes = [make_episode(spec, index) for index in range(3)]
    path = write_bag(tmp_path / "bag", spec, episodes, custom={"wm.git_commit": "abc"})
    with Bag(path) as bag:
        assert bag.custom["wm.run_id"] == "test"
        assert bag.custom["wm.git_commit"] == "abc"
        assert bag.custom["wm.policy_versions"] == "[0, 1]"
        rows = bag.episode_table()
    assert [row["seed"] for row in rows] == [1000, 1001, 1002]
    assert rows[1]["return_total"] == pytest.approx(float(episodes[1].rewards.astype(np.float64).sum()))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"images": np.zeros((6, 8, 13, 3), np.uint8)}, r"images has shape \(6, 8, 13, 3\).*\(6, 8, 12, 3\)"),
        ({"images": np.zeros((6, 8, 12, 3), np.float32)}, "must be uint8, got float32"),
        ({"states": np.zeros((5, 3), np.float32)}, r"states has shape \(5, 3\)"),
        ({"actions": np.full((5, 3), np.nan, np.float32)}, "finite"),
        ({"actions": np.full((5, 3), 1.5, np.float32)}, r"in \[-1, 1\]"),
        ({"actions": np.zeros((0, 3), np.float32)}, "no steps"),
        ({"extra": {"path": Path("x")}}, "JSON"),
    ],
)
def test_an_episode_that_does_not_fit_the_spec_is_refused_and_leaves_the_bag_whole(
    tmp_path: Path, change: dict[str, object], text: str
) -> None:
    spec = make_spec()
    good = make_episode(spec, 7)
    with EpisodeBagWriter(tmp_path / "bag", spec, run_id="test") as writer:
        with pytest.raises(ValueError, match=text):
            writer.write(make_episode(spec, **change))
        writer.write(good)
        with pytest.raises(ValueError, match="written before"):
            writer.write(good)
    (found,) = read_episodes(tmp_path / "bag")
    assert_same_episode(found, good)


def test_an_existing_bag_is_never_overwritten(tmp_path: Path) -> None:
    spec = make_spec()
    write_bag(tmp_path / "bag", spec, [make_episode(spec)])
    with pytest.raises(BagError, match="exists already"):
        EpisodeBagWriter(tmp_path / "bag", spec, run_id="test")


def test_bags_of_different_cameras_are_refused_with_the_difference(tmp_path: Path) -> None:
    one, other = make_spec(), make_spec(cameras=("front", "side"), width=16)
    path = write_bag(tmp_path / "b", other, [make_episode(other)])
    difference = r"b was recorded with another .* width 16, .* is 12; cameras \('front', 'side'\)"
    with pytest.raises(BagError, match=difference):
        next(read_episodes(path, expected=one))
    with pytest.raises(BagError, match="show the pictures that it was trained with, or record these"):
        next(read_episodes(path, expected=one))
