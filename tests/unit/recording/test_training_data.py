"""Recordings as training data: what is used and held out, what is lost, and why bags are refused."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recording_graph import NUM_ENVS, PERIOD_NS, Graph
from recording_graph import write as write_live
from recording_samples import make_episode, make_spec

from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import TRY, Episode
from wm_nodes.recording import BagError, EpisodeBagWriter, topics
from wm_nodes.recording import messages as m
from wm_nodes.recording.training_data import PART_STEPS, TrainingData, read_training_data

SPEC = make_spec(task="stir_the_pot", ground_truth_names=())


def episodes(count: int = 12, spec: EnvironmentSpec = SPEC, *, won: Sequence[int] = (0, 3, 6, 9), steps: int = 5,
             change: Callable[[Episode], Episode] = lambda episode: episode) -> list[Episode]:
    """Of noise; those in `won` succeed at their last frame."""
    made = (make_episode(spec, index, steps) for index in range(count))
    return [
        change(replace(one, success=np.arange(steps + 1) == (steps if one.episode_id in won else -1))) for one in made
    ]


def write(folder: Path, listed: Sequence[Episode], spec: EnvironmentSpec = SPEC) -> Path:
    with EpisodeBagWriter(folder, spec, run_id="lab") as bag:
        for episode in listed:
            bag.write(episode)
    return folder


def read(*bags: Path, num_heldout: int = 128) -> TrainingData:
    return read_training_data(bags, num_heldout=num_heldout, seed=0)[0]


def test_every_episode_is_on_one_side_and_both_kinds_are_on_both(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", episodes(12))
    data, whole = read_training_data([bag], num_heldout=128, seed=0)
    sides = [{image.tobytes() for image in side.images[:, 0]} for side in (data.training, data.heldout)]
    assert (len(data.training), len(data.heldout)) == (9, 3) and not sides[0] & sides[1]
    assert [int(side.success.any((1, 2)).sum()) for side in (data.training, data.heldout)] == [3, 1]
    assert [episode.images[0].tobytes() in sides[0] for episode in whole] == [True] * 9 and data.num_episodes == 9
    assert data.summary == (
        "maniskill/push_cube, task stir_the_pot: 2 x 8 x 6 px (front, wrist), 3 actions, 0 commanded and 3 measured "
        "state values",
        "used: 12 episodes, 60 steps, 72 frames; 4 succeed", "trained on: 9 (3 succeed); held out: 3 (1 succeed)",
        "lost: nothing",
    )


def test_the_same_seed_holds_the_same_episodes_out_and_num_heldout_limits_them(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", episodes(20))
    first, again = read(bag), read(bag)
    np.testing.assert_array_equal(first.heldout.images, again.heldout.images)
    assert len(read(bag, num_heldout=2).heldout) == 2


def test_a_long_episode_is_cut_in_parts_that_hold_every_step_and_stay_on_one_side(tmp_path: Path) -> None:
    spec = replace(SPEC, max_episode_steps=1000)
    steps = 2 * PART_STEPS + 1
    listed = episodes(8, spec, won=(0, 1, 2), steps=steps)
    data = read(write(tmp_path / "bag", listed, spec))
    assert data.training.lengths.tolist() == [43] * 18 and data.heldout.lengths.tolist() == [43] * 6
    assert data.training.num_steps == 43 < PART_STEPS and int(data.training.success[:, 1:].sum()) == 2
    whole = {episode.images[0].tobytes(): episode for episode in listed}
    for row in range(0, 18, 3):
        one = whole[data.training.images[row, 0].tobytes()]
        np.testing.assert_array_equal(np.concatenate(data.training.actions[row : row + 3, :43]), one.actions)
        np.testing.assert_array_equal(data.training.images[row + 2, 43], one.images[-1])
    assert "8 long episodes in 24 parts, with every step" in data.summary
    assert [len(set(side.tries)) for side in (data.training, data.heldout)] == [6, 2]


def test_episodes_of_one_try_stay_on_one_side_and_count_as_one(tmp_path: Path) -> None:
    def of_try(most: int) -> Callable[[Episode], Episode]:
        return lambda e: replace(e, extra={TRY: e.episode_id // most})

    bag = write(tmp_path / "bag", episodes(32, change=of_try(3)))
    data = read(bag)
    tries = [{(seed - 1000) // 3 for seed in side.seeds} for side in (data.training, data.heldout)]
    assert not tries[0] & tries[1] and tries[0] | tries[1] == set(range(11))
    assert [len(np.unique(side.independent)) for side in (data.training, data.heldout)] == [*map(len, tries)]
    assert "32 episodes of 11 tries; those of one try are all trained on or all held out" in data.summary
    whole, numbered = (write(tmp_path / name, episodes(20, change=change)) for name, change in (
        ("whole", lambda e: e), ("numbered", of_try(1))
    ))
    assert read(whole).heldout.seeds == read(numbered).heldout.seeds
    few = write(tmp_path / "few", episodes(14, change=of_try(2)))
    assert refused(few).startswith(f"14 complete episodes of 7 tries in {few}, and 8 are needed")
    same = write(tmp_path / "same", episodes(24, won=(4, 5), change=of_try(2)))
    assert refused(same).startswith(f"1 of 12 tries in {same} succeed, and 2 are needed")


def test_several_instructions_are_said_to_be_unread(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", episodes(change=lambda e: replace(e, instruction=f"stir pot {e.episode_id % 2}")))
    assert any(line.startswith("2 instructions: goals follow them") for line in read(bag).summary)


def test_what_a_live_recording_lost_is_said_with_its_reason_and_success_is_the_flag_without_ground_truth(
    tmp_path: Path
) -> None:
    graph = Graph(make_spec(num_envs=NUM_ENVS, ground_truth_names=()))
    graph.rollout(1, 40)
    bag = write_live(
        tmp_path / "bag", graph, drop=lambda topic, message: (
            (topic is topics.IMAGES and m.stamp_ns(message.header.stamp) == 4 * PERIOD_NS)
            or (topic is topics.TRANSITION and message.seq == 30)
        ),
    )
    data = read(bag)
    assert data.tasks == ("push_cube",) and data.training.success.any()
    used, lost = " ".join(data.summary), data.summary[-3:]
    assert re.search(r"used: (\d+) episodes", used)[1] == str(len(data.training) + len(data.heldout))  # type: ignore[index]
    assert lost[0].endswith("cut off by the start or end of the recording")
    assert "incomplete episodes (episode" in lost[1] and "the image at stamp 400000000 is missing" in lost[1]
    assert lost[2] == f"lost from {bag}: 1 message of wm/env/transition that the recorder did not get"


def refused(*bags: Path) -> str:
    with pytest.raises(BagError) as caught:
        read(*bags)
    return str(caught.value)


def test_too_few_episodes_are_refused_with_how_many_there_are_and_how_many_are_needed(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", episodes(7))
    assert refused(bag).startswith(f"7 complete episodes in {bag}, and 8 are needed")


@pytest.mark.parametrize(("won", "number"), [((), 0), ((4,), 1)])
def test_recordings_without_enough_success_are_refused_with_how_many_there_are(
    won: Sequence[int], number: int, tmp_path: Path
) -> None:
    text = refused(write(tmp_path / "bag", episodes(won=won)))
    assert text.startswith(f"{number} of 12 episodes in ") and "2 are needed" in text and "success_probability" in text


def test_a_bag_without_actions_is_refused(tmp_path: Path) -> None:
    spec = replace(SPEC, action_names=(), action_units=(), action_scale=())
    assert "was recorded without actions" in refused(write(tmp_path / "bag", [], spec))


def test_actions_that_never_change_are_refused(tmp_path: Path) -> None:
    still = episodes(change=lambda e: replace(e, actions=np.zeros_like(e.actions)))
    assert "is [0.0, 0.0, 0.0], so nothing shows what actions do" in refused(write(tmp_path / "bag", still))


def test_bags_of_different_set_ups_or_tasks_are_refused_by_what_differs(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", episodes())
    for name, change, said in (
        ("camera", {"cameras": ("top", "wrist")}, r"was recorded with another set-up: .*cameras"),
        ("box", {"state_low": (0.0, 0.0, 0.0)}, r"was recorded with another set-up: .*state_low"),
        ("task", {"task": "peel_the_onion"}, "for task 'peel_the_onion', .* for 'stir_the_pot'; train a model of each"),
    ):
        spec = replace(SPEC, **change)
        other = write(tmp_path / name, episodes(spec=spec), spec)
        with pytest.raises(BagError, match=said):
            read(bag, other)


def test_an_episode_of_another_task_in_a_bag_is_refused(tmp_path: Path) -> None:
    listed = episodes(change=lambda e: replace(e, task="peel_the_onion") if e.episode_id == 5 else e)
    assert "episode 5 in" in refused(write(tmp_path / "bag", listed))
