"""The video model behind the Environment interface. Untrained weights: only the rules count."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch
from recording_samples import make_spec
from torch import Tensor
from video_toys import rollout_config, small_codec

from wm_nodes.config.load import load_config
from wm_nodes.core.seeding import stream_seed
from wm_nodes.core.specs import SOURCE_IMAGINED, EnvironmentSpec
from wm_nodes.core.types import FloatArray, StepResult, UInt8Array
from wm_nodes.video_model import NetworkSettings, VideoNetwork, initial_noise
from wm_nodes.video_model.conditions import Condition, hashed_words
from wm_nodes.video_model.continuation import ClipLengths, continue_videos
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.video_model.video_environment import ROWS, VideoEnvironment, VideoEpisodes, check_steppable

NUM_ENVS, NUM_STARTS, HEIGHT, WIDTH = 3, 5, 16, 32
CLIP = {"stride": 1, "num_conditioning": 1, "given_frames": 4, "new_frames": 2}


def spec_of() -> EnvironmentSpec:
    commanded = ("target_x", "target_y", "target_z")
    return make_spec(
        NUM_ENVS, HEIGHT, WIDTH, instruction="push cube", max_episode_steps=6, state_names=commanded
    )


def starts() -> tuple[UInt8Array, FloatArray]:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (NUM_STARTS, HEIGHT, WIDTH, 3), dtype=np.uint8)
    return images, rng.uniform(0.5, 0.7, (NUM_STARTS, 3)).astype(np.float32)


def make_folder(**clip: int) -> VideoFolder:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = VideoNetwork(NetworkSettings(6, 3, text_dim=4, width=16, depth=2, patch=1, change_std=0.5))
        for parameter in network.parameters():  # what starts at zero makes the network say nothing
            if not parameter.any():
                torch.nn.init.normal_(parameter, std=0.1)
    codec, manifest = small_codec(4, HEIGHT, WIDTH), {"sha256": {"network": "0"}, "task": "push_cube"}
    return VideoFolder(codec, network.eval(), {**CLIP, **clip}, manifest)


class Reader:
    """Tells frames apart by their brightness; done is a frame whose first value is `done`."""

    def __init__(self) -> None:
        self.done = -1

    def read(self, frames: Tensor) -> FloatArray:
        brightness: FloatArray = (frames.float().mean((1, 2, 3)) / 512).numpy()
        return np.where(frames[:, 0, 0, 0].numpy() == self.done, np.float32(1), brightness)


def make(
    folder: VideoFolder | None = None, num_envs: int = NUM_ENVS, seed: int = 0, reader: Reader | None = None
) -> VideoEnvironment:
    config = load_config("base")
    episodes = VideoEpisodes(
        folder or make_folder(), reader or Reader(), spec_of(), starts(), config.reward, config.video_environment,
        num_envs=num_envs,
    )
    return VideoEnvironment(episodes, seed=seed)


def actions(step: int, count: int = NUM_ENVS) -> FloatArray:
    return np.random.default_rng(step).uniform(-1, 1, (NUM_ENVS, 3)).astype(np.float32)[np.arange(count) % NUM_ENVS]


def assert_same(first: StepResult, second: StepResult, rows: slice = slice(None), others: slice | None = None) -> None:
    others = rows if others is None else others
    np.testing.assert_array_equal(first.observation.image[rows], second.observation.image[others])
    np.testing.assert_array_equal(first.observation.state[rows], second.observation.state[others])
    np.testing.assert_array_equal(first.success_probability[rows], second.success_probability[others])


def test_an_episode_is_the_model_going_on_from_its_own_last_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same frames as continue_videos gives clip after clip, with the same noise."""
    monkeypatch.setattr("wm_nodes.video_model.video_environment.compute_context", lambda _: nullcontext())
    folder, seed, count = make_folder(), 7, 6
    env = make(folder, num_envs=1)
    first = env.reset(seeds=np.array([seed], np.uint64)).image
    acted = [actions(step, 1) for step in range(count)]
    seen = [env.step(action).observation.image[0] for action in acted]

    def of_new_frame(shape: tuple[int, ...], seeds: Tensor) -> Tensor:
        fresh = initial_noise((shape[0], 1, *shape[2:]), seeds)
        return torch.cat([torch.zeros(1, shape[0], shape[1] - 1, *shape[2:]), fresh], 2)

    def seeds(clip: int) -> Tensor:
        return torch.tensor([stream_seed(seed, "video_step", clip)])

    monkeypatch.setattr("wm_nodes.video_model.continuation.initial_noise", of_new_frame)
    start = Condition(
        folder.codec.encode(torch.from_numpy(first).unsqueeze(1)), torch.from_numpy(np.stack(acted, 1)),
        hashed_words(("push cube",), 4),
    )
    sampler = rollout_config(num_steps=4, shift=3.0)
    latents = continue_videos(folder.network, start, ClipLengths(4, 1), count + 1, seeds, sampler)
    expected = folder.codec.decode(latents)[0, 1:].numpy()
    assert np.abs(expected.astype(int) - np.stack(seen)).max() <= 1  # a batch of one rounds otherwise
    assert (np.diff(expected.astype(int), axis=0) != 0).any((1, 2, 3)).all()  # every frame is new


def test_equal_seeds_give_bit_identical_episodes_and_other_seeds_others() -> None:
    first, second, other = make(), make(), make()
    seeds = np.full(NUM_ENVS, 3, np.uint64)
    np.testing.assert_array_equal(first.reset(seeds=seeds).image, second.reset(seeds=seeds).image)
    other.reset(seeds=np.arange(100, 100 + NUM_ENVS, dtype=np.uint64))
    for step in range(4):
        result = first.step(actions(step))
        assert_same(result, second.step(actions(step)))
        assert (result.observation.image != other.step(actions(step)).observation.image).any((1, 2, 3)).all()


def test_an_episode_is_the_same_bit_for_bit_beside_any_others() -> None:
    """One environment alone, the same among so many that they need two calls, and reset later than its neighbours."""
    alone, many, late = make(num_envs=1), make(num_envs=ROWS + NUM_ENVS), make()
    alone.reset(seeds=np.array([7], np.uint64))
    seeds = np.arange(ROWS + NUM_ENVS, dtype=np.uint64)
    seeds[-1] = 7
    many.reset(seeds=seeds)
    late.reset(seeds=np.arange(NUM_ENVS, dtype=np.uint64))
    late.step(actions(8))
    late.reset(mask=np.array([False, True, False]), seeds=np.full(NUM_ENVS, 7, np.uint64))
    late.step(np.tile(actions(0, 1), (NUM_ENVS, 1)))  # its neighbours have more frames to go on from
    alone.step(actions(0, 1))
    many.step(np.tile(actions(0, 1), (ROWS + NUM_ENVS, 1)))
    for step in range(1, 5):
        action = actions(step, 1)
        result = alone.step(action)
        assert_same(result, many.step(np.tile(action, (ROWS + NUM_ENVS, 1))), slice(0, 1), slice(-1, None))
        assert_same(result, late.step(np.tile(action, (NUM_ENVS, 1))), slice(0, 1), slice(1, 2))


def test_a_reset_forgets_the_frames_and_actions_before_it() -> None:
    fresh, used = make(), make()
    seeds = np.full(NUM_ENVS, 5, np.uint64)
    used.reset()
    for step in range(5):
        used.step(actions(step))
    fresh.reset(seeds=seeds)
    used.reset(seeds=seeds)
    for step in range(3):
        assert_same(fresh.step(actions(step)), used.step(actions(step)))


def test_actions_steer_and_only_their_own_environment() -> None:
    one, other = make(), make()
    for env in (one, other):
        env.reset(seeds=np.arange(NUM_ENVS, dtype=np.uint64))
    changed = actions(0)
    changed[1] *= -1
    first, second = one.step(actions(0)).observation.image, other.step(changed).observation.image
    assert (first != second).any((1, 2, 3)).tolist() == [False, True, False]


def test_the_reader_of_the_new_frame_ends_an_episode_and_the_others_go_on() -> None:
    reader = Reader()
    env = make(reader=reader)
    env.reset(seeds=np.arange(NUM_ENVS, dtype=np.uint64))
    same = make()
    same.reset(seeds=np.arange(NUM_ENVS, dtype=np.uint64))
    reader.done = int(same.step(actions(0)).observation.image[1, 0, 0, 0])
    result = env.step(actions(0))
    assert result.terminated[1] and not result.truncated.any()
    assert result.success_probability[1] == 1
    ended = result.terminated
    result = env.step(actions(1))
    np.testing.assert_array_equal(result.valid, ~ended)
    np.testing.assert_array_equal(result.uncertainty, np.zeros(NUM_ENVS))


def test_damaged_weights_are_an_error_and_leave_the_episode_where_it_was() -> None:
    folder = make_folder()
    env = make(folder)
    before = env.reset()
    bias = folder.network.head.bias
    assert bias is not None
    kept = bias.detach().clone()
    with torch.no_grad():
        bias.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match="video model predicted NaN"):
        env.step(actions(0))
    np.testing.assert_array_equal(env.current().image, before.image)
    np.testing.assert_array_equal(env.current().episode_step, before.episode_step)
    with torch.no_grad():
        bias.copy_(kept)
    untouched = make()
    untouched.reset()
    assert_same(env.step(actions(0)), untouched.step(actions(0)))


def test_the_spec_says_imagined_and_names_the_model() -> None:
    env = make()
    assert (env.spec.source, env.spec.world_model_sha256) == (SOURCE_IMAGINED, env.episodes.folder.sha256)
    assert env.goals() is None


@pytest.mark.parametrize(
    ("folder", "message"),
    [
        (make_folder(given_frames=0), "cannot be stepped; train one with the preset closed_loop"),
        (make_folder(stride=2), "2 steps between two frames, and cannot be stepped"),
        (replace(make_folder(), manifest={"task": "lift_cube"}), "trained for the task lift_cube, not for push_cube"),
    ],
)
def test_a_model_that_cannot_be_stepped_is_refused_and_the_remedy_named(folder: VideoFolder, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(folder)


def test_a_measured_state_is_refused_which_no_video_model_predicts() -> None:
    with pytest.raises(ValueError, match=r"does not predict the measured state \(x, y, z\); step a world model"):
        check_steppable(make_folder(), make_spec(NUM_ENVS, HEIGHT, WIDTH))
