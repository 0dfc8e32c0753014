"""Flow matching of the embedded video model: its loss, its times, what it hides, and a model that learns to obey."""

import math

import pytest
import torch
from torch import Tensor
from video_toys import ACTION_DIM, randn, small_codec, times, tiny_network, toy_clips

from wm_nodes.config.load import load_video_config
from wm_nodes.core.seeding import torch_stream
from wm_nodes.environments.maniskill.table_top import GROUND_TRUTH_NAMES
from wm_nodes.video_model import Condition, NetworkSettings, VideoNetwork, guided_velocity
from wm_nodes.video_model.clips import Clips
from wm_nodes.video_model.flow_matching import flow_matching_loss, train_video_model
from wm_nodes.video_model.folder import VideoFolder
from wm_nodes.video_rl.sampling import GroupRequest, RecordedContexts, sample_by_ode

SHAPE = (2, 3, 4, 4)
SETTINGS = load_video_config("base").model.training


class Watched:
    """(x_t - latents) / t on generated frames, which is eps - x_0; nonsense on given ones. Keeps what it was told."""

    def __init__(self, latents: Tensor, off: float = 0.0) -> None:
        self.latents, self.off = latents, off
        self.times, self.drops = list[Tensor](), list[Tensor]()

    def __call__(self, x: Tensor, t: Tensor, condition: Condition, drop: Tensor) -> Tensor:
        K = condition.num_conditioning
        assert torch.equal(x[:, :, :K], condition.frames), "given frames are clean at every time"
        self.times.append(t)
        self.drops.append(drop)
        v = (x - self.latents) / t.view(-1, 1, 1, 1, 1).to(x.dtype) + self.off
        v[:, :, :K] = 1e3
        return v


def loss_of(model: Watched, drop: float, iteration: int = 0, given: int = 1) -> float:
    condition = Condition(
        model.latents[:, :, :given], torch.zeros(len(model.latents), SHAPE[1] - 1, ACTION_DIM), torch.zeros(16, 1, 0)
    )
    return float(flow_matching_loss(model, model.latents, condition, SETTINGS.with_values(drop=drop), 0, iteration))  # type: ignore[arg-type]


@pytest.mark.parametrize("given", [0, 1, 2])
def test_the_loss_is_the_mean_square_error_of_the_velocity_of_generated_frames(given: int) -> None:
    latents = randn(16, *SHAPE)
    assert loss_of(Watched(latents), 0.1, given=given) == pytest.approx(0.0, abs=1e-6)
    assert loss_of(Watched(latents, off=0.5), 0.1, given=given) == pytest.approx(0.25, rel=1e-3)


def test_actions_and_instruction_are_hidden_from_the_share_that_guidance_asks_for() -> None:
    latents = randn(16, *SHAPE)
    for drop in (0.0, 0.25, 1.0):
        model = Watched(latents)
        for iteration in range(250):
            loss_of(model, drop, iteration)
        hidden = torch.stack(model.drops).float()
        assert float(hidden.mean()) == pytest.approx(drop, abs=4 * math.sqrt(drop * (1 - drop) / 4000))
        if drop:
            assert bool((hidden.mean(0) > 0.1).all()), "some row is spared"


def test_half_of_the_times_are_uniform_and_half_are_shifted_towards_the_noise() -> None:
    """The mean of 3 t / (1 + 2 t) over [0, 1] is 3 / 2 - 3 ln 3 / 4 = 0.676."""
    model = Watched(randn(16, *SHAPE))
    for iteration in range(250):
        loss_of(model, 0.0, iteration)
    found = torch.stack(model.times)
    assert float(found[:, 0::2].mean()) == pytest.approx(0.5, abs=0.03)
    assert float(found[:, 1::2].mean()) == pytest.approx(1.5 - 0.75 * math.log(3), abs=0.03)
    assert bool(((found >= 0) & (found <= 1)).all())


def commanded(count: int, iteration: int) -> tuple[Tensor, Condition]:
    """Clips that brighten or darken as the action says."""
    sign = torch.randint(0, 2, (count,), generator=torch_stream(0, "commands", iteration)).mul(2).sub(1).float()
    first = 0.1 * torch.randn((count, 1, 1, 4, 4), generator=torch_stream(0, "first", iteration))
    latents = first + sign.view(-1, 1, 1, 1, 1) * torch.arange(3.0).view(1, 1, 3, 1, 1)
    actions = sign.view(-1, 1, 1).expand(count, 2, ACTION_DIM)
    return latents, Condition(first, actions, torch.zeros(count, 1, 0))


@pytest.mark.slow
def test_a_trained_model_obeys_its_actions_and_without_them_knows_only_the_mean() -> None:
    torch.manual_seed(0)
    model = VideoNetwork(NetworkSettings(1, ACTION_DIM, width=16, depth=2))
    settings = SETTINGS.with_values(num_iterations=400, learning_rate=3e-3, drop=0.2)
    train_video_model(model, lambda i: commanded(16, i), settings, seed=0, run_dir=None)
    latents, condition = commanded(64, -1)
    noise = torch.randn(latents.shape, generator=torch_stream(0, "test_noise"))
    x = torch.cat([condition.frames, noise[:, :, 1:]], 2)
    wanted, t = torch.sign(latents[:, 0, 2, 0, 0]), times(1.0).expand(64)
    with torch.no_grad():
        told, untold, guided = (
            -(v - noise)[:, :, 2].mean((1, 2, 3)) * wanted  # the clean estimate at t = 1, along the command
            for v in (model(x, t, condition), model(x, t, condition, torch.ones(64).bool()),
                      guided_velocity(model, x, t, condition, 2.0))
        )
    assert bool((told > 0.5).all()) and float(told.mean()) == pytest.approx(2, abs=0.3)
    assert abs(float(untold.mean())) < 0.3, "hidden actions say nothing of the direction"
    assert float(guided.mean()) == pytest.approx(2 * float(told.mean()) - float(untold.mean()), rel=1e-4)


def contexts(count: int, height: int, width: int) -> Clips:
    frames = torch.randint(0, 256, (count, 3, height, width, 3), generator=torch_stream(0, "pixels"), dtype=torch.uint8)
    truth = torch.zeros(count, 3, len(GROUND_TRUTH_NAMES)).numpy()
    return toy_clips(frames, torch.zeros(count, 2, ACTION_DIM), truth)


@pytest.mark.parametrize(("height", "width"), [(8, 12), (16, 24), (20, 8)])
def test_one_model_samples_and_shows_clips_of_whatever_size_its_contexts_have(height: int, width: int) -> None:
    """Made for 8 x 12 pixels, or for none: neither codec nor network is bound to a size."""
    codec = small_codec(4, 8, 12)
    folder = VideoFolder(codec, tiny_network(6), {"stride": 1, "num_conditioning": 1}, {})
    generator = RecordedContexts(folder, contexts(2, height, width), load_video_config("smoke"))
    buffer = generator.sample(GroupRequest((0, 1), 2, 0, 0))
    assert buffer.rollout.latents.shape == (4, 6, 3, height // 4, width // 4)
    shown = sample_by_ode(folder, generator.contexts, generator.config, 2)
    assert shown.shape == (2, 3, height, width, 3) and shown.dtype == torch.uint8
    assert torch.equal(buffer.condition.frames[0], codec.encode(generator.contexts.frames[:1, :1])[0])
