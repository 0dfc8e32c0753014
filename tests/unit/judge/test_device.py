"""The judge's networks compute where the setting `device` says, and there they answer and learn as on the CPU."""

from pathlib import Path

import numpy as np
import pytest
import torch
from imagined_clip import imagined, models
from numpy.testing import assert_allclose
from pretended_device import Device
from torch import nn

from wm_nodes.config.load import load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.device import DeviceError, compute_device
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import TaskSpec, clip_ref
from wm_nodes.judge.backends.embedded import EmbeddedJudge, shipped_heads
from wm_nodes.judge.backends.factory import make_judge
from wm_nodes.judge.evidence.head import TENSORS, load_head, save_head
from wm_nodes.judge.evidence.sequence import NUMBERS, READS, SIDE_PX, ObjectSequence
from wm_nodes.judge.evidence.world_model import model_evidence
from wm_nodes.judge.evidence_of_clip import ClipEvidence
from wm_nodes.judge.training.segmenter import train_segmenter
from wm_nodes.judge.training.temporal_networks import FOLDS, TemporalData, cross_fit
from wm_nodes.world_model import load_model_folder

TASK = "push the blue cube into the red target"
CPU = torch.device("cpu")
missing = pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")


def test_the_embedded_judge_reads_a_clip_on_the_device_as_on_the_cpu(device: Device, tmp_path: Path) -> None:
    frames, actions, _ = imagined()
    clip, task = clip_ref("clip", frames, 5.0), TaskSpec(TASK, "push_cube", "panda", frames[0], None, actions)
    own, head = load_head(shipped_heads()[1]), load_head(shipped_heads()[1], compute_device(device.name))
    assert {p.device.type for net in (head.segmenter, *head.readers) for p in net.parameters()} == {"cuda"}
    here, there = EmbeddedJudge(own).evidence(clip, task), EmbeddedJudge(head).evidence(clip, task)
    assert_allclose(list(there.values()), list(here.values()), rtol=1e-4, atol=1e-4)
    folders = [save_head(tmp_path / name, judge) for name, judge in (("here", own), ("there", head))]
    files = [(folder / TENSORS).read_bytes() for folder in folders]
    assert files[0] == files[1], "a judge of a GPU is saved for every machine"


def test_the_settings_judge_is_made_on_the_device(device: Device) -> None:
    settings = load_config("smoke", {"judge.kind": "embedded"}).judge
    judge = make_judge(settings, load_rubric(), device=device.name).judge
    assert isinstance(judge, EmbeddedJudge) and judge._head.segmenter.out.weight.device.type == "cuda"


def test_a_world_model_on_the_device_gives_the_evidence_of_the_cpu(device: Device) -> None:
    frames, actions, states = imagined()
    there = load_model_folder(shipped_model("push_cube"), compute_device(device.name))
    for shown, given in ((frames, actions), (frames[::2], actions.reshape(len(actions) // 2, -1))):
        for start in (states, None):
            task = TaskSpec(TASK, "push_cube", "panda", shown[0], shown[-1], given)
            expected, found = model_evidence(models(), shown, task, start), model_evidence(there, shown, task, start)
            assert expected.keys() == found.keys()
            assert_allclose(list(found.values()), list(expected.values()), rtol=2e-3, atol=2e-3)


def test_training_on_the_device_learns_what_it_learns_on_the_cpu(device: Device, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    images, masks = rng.integers(0, 256, (8, 16, 16, 3), np.uint8), rng.integers(0, 4, (8, 16, 16), np.uint8)
    there = compute_device(device.name)
    segmenters = [train_segmenter(images, masks, num_steps=12, seed=1, progress=False, device=d) for d in (CPU, there)]
    assert segmenters[1].out.weight.device.type == "cuda"
    same_weights(*segmenters)
    answers, folds = rng.integers(0, 2, (8, len(READS))), np.arange(8) % FOLDS
    data = TemporalData([random_sequence(rng) for _ in folds], answers, folds)
    readers, odds = zip(*(
        cross_fit(tmp_path / d.type, data, count=1, epochs=3, seed=0, progress=False, device=d) for d in (CPU, there)
    ))
    for pair in zip(*readers):
        same_weights(*pair)
    assert_allclose(odds[1], odds[0], rtol=1e-3, atol=1e-4)
    kept = {path.name: path.read_bytes() for path in (tmp_path / "cuda").iterdir()}
    again, _ = cross_fit(tmp_path / "cuda", data, count=1, epochs=3, seed=0, progress=False)
    assert {path.name: path.read_bytes() for path in (tmp_path / "cuda").iterdir()} == kept
    assert {reader.mean.device.type for reader in again} == {"cpu"}, "what a GPU has finished, a CPU takes up"


def random_sequence(rng: np.random.Generator) -> ObjectSequence:
    crops = rng.integers(0, 256, (5, SIDE_PX, SIDE_PX, 4), np.uint8)
    return ObjectSequence(crops, rng.normal(size=(5, len(NUMBERS))).astype(np.float32))


def same_weights(own: nn.Module, other: nn.Module) -> None:
    for name, tensor in own.state_dict().items():
        assert_allclose(other.state_dict()[name].cpu().numpy(), tensor.numpy(), rtol=1e-3, atol=1e-4, err_msg=name)


@missing
def test_a_judge_on_a_gpu_that_is_not_there_is_refused_in_one_line() -> None:
    settings = load_config("smoke", {"judge.kind": "embedded"}).judge
    with pytest.raises(DeviceError, match="device is cuda, but torch"):
        make_judge(settings, load_rubric(), device="cuda")
    with pytest.raises(DeviceError, match="device is cuda:1, but torch"):
        ClipEvidence(shipped_model("push_cube"), "cuda:1").check(load_rubric("robot_push_cube"))
