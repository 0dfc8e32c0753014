"""Which steps are stochastic and which of them train: the window of Mix-GRPO, step fractions."""

import pytest
import torch
from torch import Tensor

from wm_nodes.config.video import WindowConfig
from wm_nodes.video_model import select_steps, stochastic_steps


def window(iteration: int, strategy: str = "progressive", *, num_steps: int = 10, period: int = 25) -> list[int]:
    return stochastic_steps(num_steps, WindowConfig(strategy=strategy, size=4, period=period), iteration)  # type: ignore[arg-type]


def selected(num_steps: int = 11, num_samples: int = 3, **changes: object) -> Tensor:
    options: dict[str, object] = {"fraction": 0.55, "seed": 0, "iteration": 0}
    return select_steps(num_steps - 1, num_samples, **{**options, **changes})  # type: ignore[arg-type]


def test_without_a_window_every_step_but_the_last_is_stochastic() -> None:
    for num_steps in range(1, 51):
        assert window(3, "all", num_steps=num_steps) == list(range(num_steps - 1))


def test_a_progressive_window_moves_on_by_one_each_period_and_rolls_back_to_its_start() -> None:
    """10 steps, window of 4: starts 0 to 5, and 5 + 4 = 9 is the last step, which stays out."""
    starts = [window(25 * i)[0] for i in range(8)]
    assert starts == [0, 1, 2, 3, 4, 5, 0, 1]
    assert window(24) == [0, 1, 2, 3] and window(25) == [1, 2, 3, 4]


def test_a_window_is_never_shorter_than_its_size_and_never_holds_the_last_step() -> None:
    """Mix-GRPO's own state machine gives lengths 4, 3, 2, 1, 0 near the end."""
    for num_steps in (6, 10, 25, 50):
        for iteration in range(0, 400, 7):
            steps = window(iteration, num_steps=num_steps, period=3)
            assert len(steps) == 4 and steps == list(range(steps[0], steps[0] + 4)) and steps[-1] < num_steps - 1


def test_a_window_as_long_as_all_stochastic_steps_is_all_of_them() -> None:
    assert window(77, num_steps=5) == [0, 1, 2, 3]
    assert window(77, num_steps=3) == [0, 1]
    assert window(77, num_steps=1) == []


@pytest.mark.parametrize("bad", [{"size": 0}, {"period": 0}])
def test_an_empty_window_or_period_is_refused(bad: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="greater than or equal to 1"):
        WindowConfig(**{"strategy": "progressive", "size": 4, "period": 25, **bad})


# which of them train


def test_a_fraction_trains_its_floor_of_the_stochastic_steps_of_each_video() -> None:
    """0.55 of 10 stochastic steps is 5."""
    chosen = selected(num_samples=50)
    assert chosen.shape == (50, 10) and chosen.sum(1).tolist() == [5] * 50
    assert len({tuple(row) for row in chosen.tolist()}) > 30, "each video has its own"
    assert bool(chosen.any(0).all())
    assert torch.equal(chosen, selected(num_samples=50)) and not torch.equal(
        chosen, selected(num_samples=50, iteration=1)
    )
    assert torch.equal(chosen[:7], selected(num_samples=7)), "more videos do not change the choice of the first"


@pytest.mark.parametrize("fraction", [0.0, 0.01, 1.0])
def test_at_least_one_step_always_trains(fraction: float) -> None:
    for num_steps in (2, 3, 50):
        chosen = selected(num_steps, fraction=fraction)
        assert bool(chosen.any(1).all())
        if fraction == 1.0:
            assert bool(chosen.all())


def test_no_stochastic_step_is_an_error_that_says_what_to_do() -> None:
    with pytest.raises(ValueError, match=r"no step can train: .*take more sampler steps"):
        selected(num_steps=1)
