"""The reader of where things are: it learns to read places that it was not shown, and says whose pictures it reads."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pushing_scene import episode, stacked_scene
from recording_samples import make_episode

from wm_nodes.config.load import load_config
from wm_nodes.config.object_state import READER, of_demonstrations, with_reader, with_truth
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.environments.object_reader import ObjectReader, keypoints, load_object_reader
from wm_nodes.environments.registry import configured_spec
from wm_nodes.policy_rl.initial_policy import as_read
from wm_nodes.policy_rl.object_reader import train_object_reader
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.training.weights import save_weights

SETTINGS = {"world_model.object_reader_iterations": 300, "tokenizer.batch_size": 32}


def shown(count: int, first_seed: int = 0) -> EpisodeArrays:
    """Drawn episodes whose states say where the object is."""
    arrays = stacked_scene([episode(first_seed + i) for i in range(count)], ("push_cube", "reach"))
    return replace(arrays, states=np.concatenate([arrays.states, arrays.ground_truth[..., :2]], -1))


def spec_of(arrays: EpisodeArrays) -> EnvironmentSpec:
    spec, (height, width) = configured_spec(load_config("base", {"task": "push_cube"})), arrays.images.shape[2:4]
    return replace(
        spec, height=height, width=width, state_names=(*spec.state_names, "object_x", "object_y"),
        state_units=(*spec.state_units, "m", "m"), state_low=(*spec.state_low, -10, -10),
        state_high=(*spec.state_high, 10, 10),
    )


def test_keypoints_are_where_a_map_is_highest() -> None:
    maps = torch.zeros(1, 2, 9, 17)
    maps[0, 0, 2, 12] = maps[0, 1, 8, 0] = 40.0
    x, y, top = keypoints(maps, torch.ones(())).reshape(3, 2)
    torch.testing.assert_close(x, torch.tensor([0.5, -1.0]))
    torch.testing.assert_close(y, torch.tensor([-0.5, 1.0]))
    assert top.tolist() == [40.0, 40.0]


@pytest.mark.slow
def test_a_trained_reader_reads_places_that_it_has_not_seen_and_leaves_the_rest(tmp_path: Path) -> None:
    seen = shown(120)
    spec = spec_of(seen)
    reader, metrics = train_object_reader(seen, spec, load_config("base", SETTINGS), None)
    assert metrics["error_m"] < 0.02
    unseen = shown(16, 10_000)
    images, states = unseen.images[:, 0], unseen.states[:, 0]
    blank = states.copy()
    blank[:, spec.measured] = 0
    save_weights(reader, tmp_path / READER)
    read = load_object_reader(tmp_path / READER, spec).fill(images, blank)
    np.testing.assert_array_equal(read[:, : spec.commanded_dim], states[:, : spec.commanded_dim])
    away = np.linalg.norm((states - states.mean(0))[:, spec.measured], axis=1).mean()
    assert np.linalg.norm((read - states)[:, spec.measured], axis=1).mean() < 0.35 * away


def test_another_camera_and_another_robots_reader_are_refused(tmp_path: Path) -> None:
    spec = spec_of(shown(1))
    reader = ObjectReader(spec)
    with pytest.raises(ValueError, match="trained for another camera set-up"):
        reader.fill(np.zeros((1, 8, 8, 3), np.uint8), np.zeros((1, spec.state_dim), np.float32))
    with pytest.raises(ValueError, match="there is no such file; name a world model's"):
        load_object_reader(tmp_path / READER, spec)
    save_weights(reader, tmp_path / READER)
    other = replace(spec, state_names=(*spec.state_names, "object_z"), state_units=(*spec.state_units, "m"))
    with pytest.raises(ValueError, match=r"is no object reader for .*push_cube"):
        load_object_reader(tmp_path / READER, other)


def test_what_was_at_the_start_of_a_clip_is_read_off_its_first_picture() -> None:
    spec = configured_spec(load_config("base", {"task": "push", "simulation.object_state": "truth"}))
    images = np.random.default_rng(0).integers(0, 256, (3, spec.height, spec.width, 3), np.uint8)
    filled = ObjectReader(spec).fill_clip(images, np.zeros((3, spec.state_dim), np.float32))
    now, start = (filled[:, spec.state_names.index(name)] for name in ("object_x", "object_start_x"))
    assert (start == now[0]).all() and len(set(now)) == 3


def test_a_demonstration_as_read_says_of_the_start_what_its_first_picture_shows() -> None:
    spec = configured_spec(load_config("base", {"task": "all_tasks", "simulation.object_state": "truth"}))
    demo = make_episode(spec, 0, steps=4)
    states = as_read(demo, ObjectReader(spec)).states
    for axis in "xy":
        now, start = (states[:, spec.state_names.index(name)] for name in (f"object_{axis}", f"object_start_{axis}"))
        assert (start == now[0]).all() and len(set(now)) == 5
    assert (states[:, : spec.commanded_dim] == demo.states[:, : spec.commanded_dim]).all()


def test_states_say_the_truth_while_a_model_is_made_and_then_what_its_reader_sees(tmp_path: Path) -> None:
    plain, made = load_config("base", {"task": "push"}), load_config("base", {"task": "push", **SETTINGS})
    assert with_truth(plain) is plain and with_truth(made).simulation.object_state == "truth"
    assert with_reader(plain, tmp_path) is plain and with_reader(plain, None) is plain
    (tmp_path / READER).touch()
    assert with_reader(plain, tmp_path).simulation.object_state == str(tmp_path / READER)
    assert with_reader(with_truth(made), tmp_path).simulation.object_state == "truth"


def test_demonstrations_say_the_truth_where_a_policy_learns_both_it_and_what_is_read() -> None:
    both = {"task": "push", "simulation.object_state": "reader.safetensors", "sft.state_noise_m": 0.004}
    assert of_demonstrations(load_config("base", both)).simulation.object_state == "truth"
    for plain in ({**both, "sft.state_noise_m": 0.0}, {**both, "simulation.object_state": ""}):
        config = load_config("base", plain)
        assert of_demonstrations(config) is config
