"""The setting `device`: which values there are, and what is said where a GPU is missing or too small."""

import pytest
import torch

from wm_nodes.config.load import ConfigError, load_config, load_video_config
from wm_nodes.core.device import DeviceError, compute_device, explain_memory

here = pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")


@pytest.mark.parametrize("load", [load_config, load_video_config])
def test_both_loops_compute_on_the_cpu_unless_told_otherwise(load):
    assert load().device == "cpu"
    assert load(overrides={"device": "cuda:1"}).device == "cuda:1"
    for wrong in ("gpu", "cuda:", "cuda:x", "CPU", ""):
        with pytest.raises(ConfigError, match="device"):
            load(overrides={"device": wrong})


@here
def test_auto_is_the_cpu_without_a_gpu():
    assert compute_device("auto") == compute_device("cpu") == torch.device("cpu")


@here
@pytest.mark.parametrize("name", ["cuda", "cuda:3"])
def test_a_missing_gpu_is_one_line_with_the_remedy(name):
    with pytest.raises(DeviceError, match=rf"device is {name}, but torch .* sees no GPU; set device to cpu or auto"):
        compute_device(name)


def test_a_gpu_that_this_machine_does_not_have_is_named(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert compute_device("auto") == compute_device("cuda") == torch.device("cuda", 0)
    assert compute_device("cuda:1") == torch.device("cuda", 1)
    with pytest.raises(DeviceError, match="device is cuda:2, but the GPUs here are cuda:0 to cuda:1"):
        compute_device("cuda:2")


def test_too_little_memory_names_the_settings_to_lower():
    with pytest.raises(DeviceError) as caught, explain_memory("cuda:0", ppo__num_envs=1024, ppo__minibatch_size=1):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.")
    assert str(caught.value) == (
        "the memory of cuda:0 is too small; lower ppo.num_envs from 1024 to 512, ppo.minibatch_size from 1 to 1, or "
        "take a smaller preset"
    )
