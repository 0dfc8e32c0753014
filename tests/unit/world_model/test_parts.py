"""Inference in parts, in several threads: the rows of the whole, in order."""

import os
import threading

import pytest
import torch
from deadlines import PATIENCE_S

from wm_nodes.world_model.parts import PART, in_parallel, in_parts, parts_of

CPU = torch.device("cpu")


@pytest.mark.parametrize("batch", [0, 1, PART, PART + 1, 64, 100])
def test_parts_cover_the_batch_once_in_near_equal_sizes(batch: int) -> None:
    parts = parts_of(batch, CPU)
    assert [row for rows in parts for row in range(rows.start, rows.stop)] == list(range(batch))
    sizes = [rows.stop - rows.start for rows in parts]
    assert max(sizes) <= PART
    assert max(sizes) - min(sizes) <= 1
    assert parts_of(batch, torch.device("cuda")) == [slice(0, batch)]


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_parts_are_computed_at_the_same_time_with_one_torch_thread_each_and_without_gradients() -> None:
    both = threading.Barrier(2, timeout=PATIENCE_S)

    def work(item: int) -> tuple[int, bool, int]:
        both.wait()
        return item, torch.is_inference_mode_enabled(), torch.get_num_threads()

    assert in_parallel(work, [0, 1]) == [(0, True, 1), (1, True, 1)]


def test_results_come_in_the_order_of_the_rows_and_an_error_is_raised() -> None:
    values = torch.arange(100.0)
    assert torch.equal(in_parts(lambda rows: 2 * values[rows], 100, CPU), 2 * values)

    def fail(rows: slice) -> torch.Tensor:
        raise FloatingPointError(f"row {rows.start}")

    with pytest.raises(FloatingPointError, match="row 0"):
        in_parts(fail, 100, CPU)
