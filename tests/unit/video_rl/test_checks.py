"""What the doctor finds on a model that is well, and on settings or models that would spoil a training."""

from typing import Any

import pytest
import torch
from video_toys import (
    Analytic,
    grpo_config,
    kl_config,
    rollout_config,
    sampler_config,
    toy_condition,
)

from wm_nodes.apps.cli import main
from wm_nodes.config.load import load_video_config
from wm_nodes.config.video import GrpoConfig, RolloutConfig, VideoRlConfig
from wm_nodes.video_model import Condition
from wm_nodes.video_rl.checks import CheckResult, examine
from wm_nodes.video_rl.toy_scene import draw_scenes, load_base

SHAPE = (2, 6, 16, 16)
ROLLOUT = rollout_config(num_steps=4, shift=3.0)
RATIO, KL = "ratio is 1 on the first update", "KL is 0 at the anchor"


def settings(rollout: RolloutConfig = ROLLOUT, grpo: GrpoConfig | None = None) -> VideoRlConfig:
    base = load_video_config("base")
    return base.with_values(rollout=rollout, grpo=grpo or base.grpo)


def findings(
    rollout: RolloutConfig = ROLLOUT, grpo: GrpoConfig | None = None, model: Any = None
) -> dict[str, CheckResult]:
    condition = draw_scenes(4, 0, "doctor").condition()
    return {f.name: f for f in examine(model or load_base(), condition, SHAPE, settings(rollout, grpo))}


@pytest.mark.parametrize("arm", ["cps", "dyndiff", "flow", "dance", "sage"])
@pytest.mark.parametrize("anchor", ["buffer", "frozen", "dual"])
def test_a_sound_model_passes_with_every_sampler_and_anchor(arm: Any, anchor: Any) -> None:
    found = findings(ROLLOUT.with_values(sampler=sampler_config(arm, 0.6)), grpo_config(kl=kl_config(anchor=anchor)))
    assert [name for name, finding in found.items() if not finding.passed] == []
    assert anchor in found[KL].value


def test_a_guided_model_passes() -> None:
    config = load_video_config("recommended")
    assert findings(config.rollout.with_values(cfg=2.0), config.grpo)[RATIO].passed


def test_an_image_is_explored_everywhere_and_passes() -> None:
    rows = Condition(torch.zeros(4, 2, 0, 8, 8), torch.zeros(4, 0, 4), torch.zeros(4, 1, 0))
    found = {f.name: f for f in examine(load_base(), rows, (2, 1, 8, 8), settings())}
    assert all(finding.passed for finding in found.values()) and "single frame" in found["the mask is not flat"].value


def test_a_model_whose_output_is_not_finite_is_the_only_finding() -> None:
    ((name, finding),) = findings(model=Analytic(lambda x, t: x / 0)).items()
    assert name == "sampled videos are finite" and not finding.passed and finding.value == "4 of 4 are not"


@pytest.mark.parametrize("trains", ["all", "condition"])
def test_what_trains_is_asked_for_gradients_as_before(trains: Any) -> None:
    model = load_base()
    model.head.requires_grad_(False)
    asked = [p.requires_grad for p in model.parameters()]
    assert findings(grpo=grpo_config(trains=trains), model=model)[RATIO].passed
    assert [p.requires_grad for p in model.parameters()] == asked and all(p.grad is None for p in model.parameters())


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("grpo.kl.anchor=lora_off", "needs a model with a LoRA adapter"),
        ("rollout.num_steps=1", "no step can train"),
        ("rollout.sampler.arm=ode", "has no likelihood to train on"),
        ("rollout.sampler.eta=1.5", "got 1.5"),
    ],
)
def test_settings_that_cannot_train_are_one_clear_error(
    setting: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check-video-model", f"--{setting}"]) == 2
    assert words in capsys.readouterr().err


def test_the_doctor_passes_the_shipped_toy_model_and_leaves_it_as_it_was() -> None:
    model, config = load_base(), load_video_config("recommended")
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    findings = examine(model, draw_scenes(4, 0, "doctor").condition(), (2, 6, 16, 16), config)
    assert [finding.name for finding in findings if not finding.passed] == []
    assert all(torch.equal(tensor, before[name]) for name, tensor in model.state_dict().items())


def test_the_doctor_names_a_flat_mask_and_a_ratio_that_is_not_1() -> None:
    config = load_video_config("recommended")
    condition = toy_condition(3, (2, 5, 8, 8))
    restless = Analytic(lambda x, t: x + 0.3 * torch.randn_like(x))  # other noise on every call, as dropout would give
    findings = {f.name: f for f in examine(restless, condition, (2, 5, 8, 8), config)}
    assert not findings["ratio is 1 on the first update"].passed
    assert "dropout" in findings["ratio is 1 on the first update"].remedy
