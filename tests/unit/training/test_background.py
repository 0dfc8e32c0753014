"""Batches that are read one ahead for a device are those that are read when they are asked for."""

import threading

import pytest
import torch
from pretended_device import Device
from torch import Tensor

from wm_nodes.core.device import compute_device
from wm_nodes.training.background import BackgroundBatches


def test_a_device_gets_every_batch_once_read_ahead_and_copied_without_a_wait(device: Device) -> None:
    asked, threads = list[int](), set[str]()

    def read(iteration: int) -> tuple[Tensor, Tensor]:
        asked.append(iteration)
        threads.add(threading.current_thread().name)
        return torch.full((2,), iteration), torch.zeros(1)

    batches = BackgroundBatches(read, compute_device(device.name))
    got = [batches(iteration) for iteration in (3, 4, 5, 9)]  # a resumed run begins anywhere; a jump is read anew
    assert [first.tolist() for first, _ in got] == [[3, 3], [4, 4], [5, 5], [9, 9]]
    assert all(tensor.device.type == "cuda" for batch in got for tensor in batch)
    batches(10)
    assert {3, 4, 5, 6, 9, 10} <= set(asked) and asked.count(4) == asked.count(5) == 1
    assert len(threads) == 2


def test_copies_wait_for_nothing(device: Device) -> None:
    if device.counts is None:
        pytest.skip("a real device does not count")
    batches = BackgroundBatches(lambda iteration: (torch.zeros(4), torch.ones(2)), compute_device(device.name))
    device.counts.reset()
    batches(0)
    assert (device.counts.waits, device.counts.copies_up, device.counts.copies_down) == (0, 2, 0)


def test_a_batch_that_cannot_be_read_raises_where_it_is_asked_for(device: Device) -> None:
    def read(iteration: int) -> tuple[Tensor]:
        if iteration == 1:
            raise ValueError("episode 7 is damaged")
        return (torch.zeros(1),)

    batches = BackgroundBatches(read, compute_device(device.name))
    batches(0)
    with pytest.raises(ValueError, match="episode 7 is damaged"):
        batches(1)


def test_the_cpu_reads_in_its_own_thread_and_only_what_is_asked_for() -> None:
    asked = list[tuple[int, str]]()

    def read(iteration: int) -> tuple[Tensor]:
        asked.append((iteration, threading.current_thread().name))
        return (torch.zeros(1),)

    batches = BackgroundBatches(read, torch.device("cpu"))
    batches(0), batches(1)
    assert asked == [(number, threading.current_thread().name) for number in (0, 1)]
