"""What the video network says of velocities around the last given frame. Shapes: B clips, C channels, F frames."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from video_toys import ACTION_DIM, SHAPE, tiny_network, toy_condition

from wm_nodes.video_model import Condition, NetworkSettings, VideoNetwork
from wm_nodes.video_model.conditions import hashed_words
from wm_nodes.video_model.kernels import with_conditioning
from wm_nodes.video_model.network import LEAST_SPREAD
from wm_nodes.video_rl.pretraining import change_std

B, C, F = 64, 2, 5
CHANGE = 0.4


def network(spread: float) -> VideoNetwork:
    """As at its first step, whose output is everywhere mean 0 and deviation CHANGE x (softplus(spread) +
    LEAST_SPREAD)."""
    made = VideoNetwork(NetworkSettings(C, ACTION_DIM, width=8, depth=1, change_std=CHANGE))
    assert made.head.bias is not None
    with torch.no_grad():
        made.head.bias[C:] = spread
    return made


def case(deviation: float, given: int = 1) -> tuple[Condition, Tensor, Tensor]:
    """Clips that change from their last given frame by noise of this deviation; their noise. Odd height and width."""
    generator = torch.Generator().manual_seed(0)
    condition = toy_condition(B, (C, F, 5, 7), given)
    change = deviation * torch.randn(B, C, F - given, 5, 7, generator=generator)
    last = condition.frames[:, :, -1:] if given else torch.zeros(B, C, 1, 5, 7)
    clips = torch.cat([condition.frames, last + change], 2)
    return condition, clips, torch.randn(clips.shape, generator=generator)


def velocity(net: VideoNetwork, condition: Condition, clips: Tensor, noise: Tensor, time: float) -> Tensor:
    x_t = with_conditioning((1 - time) * clips + time * noise, condition.frames)
    with torch.no_grad():
        return net(x_t, torch.full((B,), time, dtype=torch.float64), condition)


@pytest.mark.parametrize("time", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("given", [0, 1, 2])
def test_with_the_change_s_own_deviation_the_first_guess_is_the_best_linear_one(time: float, given: int) -> None:
    spread = math.log(math.expm1(1 - LEAST_SPREAD))
    condition, clips, noise = case(CHANGE, given)
    error = (velocity(network(spread), condition, clips, noise, time) - (noise - clips))[:, :, given:]
    last = condition.frames[:, :, -1:] if given else 0.0
    seen = ((1 - time) * (clips - last) + time * noise)[:, :, given:]
    assert float((error * seen).mean()) == pytest.approx(0, abs=0.02)  # the least-squares condition
    expected = CHANGE**2 / ((1 - time) ** 2 * CHANGE**2 + time**2)
    assert float(error.square().mean()) == pytest.approx(expected, rel=0.05)


def test_where_nothing_changes_the_velocity_is_known_but_for_the_least_spread() -> None:
    condition, clips, noise = case(0.0)
    for time, limit in ((0.2, 0.02), (1.0, 0.001)):
        error = (velocity(network(-30.0), condition, clips, noise, time) - (noise - clips))[:, :, 1:]
        assert float(error.square().mean()) < limit


def test_a_clip_s_condition_does_not_depend_on_the_longer_instruction_of_a_neighbour() -> None:
    """Their words are averaged over each one's own; the padding is zeros."""
    net, E = tiny_network(text_dim=8), 8
    words = hashed_words(["push the cube", "push the cube to the goal", ""], E)
    condition, shape = toy_condition(3, text_dim=E), (3, *SHAPE)
    condition = replace(condition, text=words)
    x, t = torch.randn(shape, generator=torch.Generator().manual_seed(0)), torch.full((3,), 0.5, dtype=torch.float64)
    together = net(x, t, condition)
    for row, length in enumerate((3, 6, 0)):
        alone = replace(condition.rows(slice(row, row + 1)), text=words[row : row + 1, :length])
        torch.testing.assert_close(net(x[row : row + 1], t[:1], alone), together[row : row + 1], rtol=1e-5, atol=1e-6)


def test_the_mean_of_instructions_of_one_length_is_what_it_was_bit_for_bit() -> None:
    net, condition = tiny_network(text_dim=8), toy_condition(2, text_dim=8)
    seen: list[Tensor] = []
    net.text.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    net(torch.zeros(2, *SHAPE), torch.ones(2, dtype=torch.float64), condition)
    assert torch.equal(seen[0], condition.text.sum(1) / 3)


def test_change_std_is_measured_after_the_last_given_frame() -> None:
    condition, clips, _ = case(0.3, given=2)
    assert change_std(clips, 2) == pytest.approx(0.3, rel=0.02)
    assert change_std(clips, 0) == pytest.approx(float(clips.square().mean().sqrt()))
    assert condition.num_conditioning == 2
