"""The embedded judge computes where the setting `device` says, and there it answers as on the CPU."""


import pytest
import torch
from numpy.testing import assert_allclose
from pretended_device import Device

from wm_nodes.config.load import load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.device import DeviceError
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.backends.factory import evidence_judge, for_task, make_judge
from wm_nodes.judge.backends.one_class import OneClassJudge
from wm_nodes.judge.check_set import load_check_set

SETTINGS = for_task(load_config("smoke", {"judge.kind": "embedded"}).judge, "push_cube")
missing = pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")


def test_the_embedded_judge_finds_on_the_device_what_it_finds_on_the_cpu(device: Device) -> None:
    there, here = (make_judge(SETTINGS, load_rubric(), device=name).judge for name in (device.name, "cpu"))
    assert isinstance(there, OneClassJudge) and isinstance(here, OneClassJudge)
    assert next(there._models.action.parameters()).device.type == "cuda"
    labelled = next(clip for clip in load_check_set() if clip.truth.part == "policy")
    found, expected = (judge.evidence(labelled.job.clip, labelled.job.task) for judge in (there, here))
    assert found.keys() == expected.keys() and expected
    assert_allclose(list(found.values()), list(expected.values()), rtol=2e-3, atol=2e-3)


@missing
def test_a_judge_on_a_gpu_that_is_not_there_is_refused_in_one_line() -> None:
    with pytest.raises(DeviceError, match="device is cuda, but torch"):
        make_judge(SETTINGS, load_rubric(), device="cuda")
    server = SETTINGS.model_copy(update={"kind": "openai", "endpoints": ["http://a/v1"], "model": "m"})
    with pytest.raises(DeviceError, match="device is cuda:1, but torch"):
        evidence_judge(server, shipped_model("push_cube"), "cuda:1")
