"""Which steps are stochastic and which of them train: windows of Mix-GRPO and Flow-GRPO-Fast, step fractions."""

import pytest
import torch
from torch import Tensor
from video_toys import times

from wm_nodes.config.video import WindowConfig
from wm_nodes.video_model import flow_times, select_steps, stochastic_steps


def window(
    strategy: str, iteration: int, *, num_steps: int = 10, size: int = 4, period: int = 25, seed: int = 0
) -> list[int]:
    return stochastic_steps(num_steps, WindowConfig(strategy=strategy, size=size, period=period), iteration, seed)  # type: ignore[arg-type]


def selected(num_steps: int = 11, num_samples: int = 3, **changes: object) -> Tensor:
    options: dict[str, object] = {"fraction": 0.55, "min_s": 0.0, "seed": 0, "iteration": 0}
    return select_steps(flow_times(num_steps), list(range(num_steps - 1)), num_samples, **{**options, **changes})  # type: ignore[arg-type]


def test_without_a_window_every_step_but_the_last_is_stochastic() -> None:
    for num_steps in range(1, 51):
        assert window("all", 3, num_steps=num_steps) == list(range(num_steps - 1))


def test_a_progressive_window_moves_on_by_one_each_period_and_rolls_back_to_its_start() -> None:
    """10 steps, window of 4: starts 0 to 5, and 5 + 4 = 9 is the last step, which stays out."""
    starts = [window("progressive", 25 * i)[0] for i in range(8)]
    assert starts == [0, 1, 2, 3, 4, 5, 0, 1]
    assert window("progressive", 24) == [0, 1, 2, 3] and window("progressive", 25) == [1, 2, 3, 4]


@pytest.mark.parametrize("strategy", ["progressive", "random", "fast"])
def test_a_window_is_never_shorter_than_its_size_and_never_holds_the_last_step(strategy: str) -> None:
    """Mix-GRPO's own state machine gives lengths 4, 3, 2, 1, 0 near the end."""
    for num_steps in (6, 10, 25, 50):
        for iteration in range(0, 400, 7):
            steps = window(strategy, iteration, num_steps=num_steps, period=3)
            assert len(steps) == 4 and steps == list(range(steps[0], steps[0] + 4)) and steps[-1] < num_steps - 1


@pytest.mark.parametrize("strategy", ["progressive", "random", "fast"])
def test_a_window_as_long_as_all_stochastic_steps_is_all_of_them(strategy: str) -> None:
    assert window(strategy, 77, num_steps=5) == [0, 1, 2, 3]
    assert window(strategy, 77, num_steps=3) == [0, 1]
    assert window(strategy, 77, num_steps=1) == []


def test_a_random_window_reaches_every_start_and_is_the_same_for_the_same_seed() -> None:
    starts = [window("random", i)[0] for i in range(200)]
    assert set(starts) == set(range(6))
    assert starts == [window("random", i)[0] for i in range(200)]
    assert starts != [window("random", i, seed=1)[0] for i in range(200)]


def test_the_fast_window_stays_in_the_first_half() -> None:
    found = {tuple(window("fast", i, size=2)) for i in range(200)}
    assert found == {(k, k + 1) for k in range(4)}


@pytest.mark.parametrize("bad", [{"size": 0}, {"period": 0}])
def test_an_empty_window_or_period_is_refused(bad: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="greater than or equal to 1"):
        WindowConfig(**{"strategy": "random", "size": 4, "period": 25, **bad})


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


def test_steps_that_end_too_close_to_the_data_do_not_train() -> None:
    """Steps of 0.1 that end at 0.9, ..., 0.1: of those at or above 0.25 there are 7."""
    chosen = selected(num_steps=10, num_samples=30, fraction=1.0, min_s=0.25)
    assert chosen.any(0).tolist() == [True] * 7 + [False] * 2 and chosen.sum(1).tolist() == [7] * 30


def test_a_selection_counts_positions_among_the_stochastic_steps() -> None:
    chosen = select_steps(flow_times(10), [3, 4, 5, 6], 2, fraction=1.0, min_s=0.45, seed=0, iteration=0)
    assert chosen.tolist() == [[True, True, False, False]] * 2


@pytest.mark.parametrize(("steps", "min_s"), [([], 0.0), ([0, 1], 0.9)])
def test_no_step_that_could_train_is_an_error_that_says_what_to_do(steps: list[int], min_s: float) -> None:
    with pytest.raises(ValueError, match=r"no step can train: .*take more sampler steps, or lower grpo.min_s"):
        select_steps(times(1, 0.5, 0.2, 0), steps, 2, fraction=1.0, min_s=min_s, seed=0, iteration=0)
