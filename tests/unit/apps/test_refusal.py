"""What `train-policy` refuses: a policy that training could only lower, and one that would see nothing."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from wm_nodes.apps import train_policy
from wm_nodes.config.load import load_config
from wm_nodes.world_model.validation.acceptance import CloneRollouts, accept_video_model
from wm_nodes.world_model.validation.acceptance_report import AcceptanceReport


def test_it_is_told_to_stay_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_config("cpu", {"acceptance.success_margin": 0.5})
    wins = np.repeat([True, False], [59, 5])
    clone = CloneRollouts(np.ones(64, np.bool_), wins, wins)

    def judged(*given: Any, **_: Any) -> AcceptanceReport:
        return accept_video_model(config, given[3], given[4], [clone])

    said = list[str]()
    job: Any = SimpleNamespace(config=config, run_dir=tmp_path, video_model="", stage=said.append)
    monkeypatch.setattr(train_policy, "accept_model", judged)
    monkeypatch.setattr(train_policy, "load_policy", lambda *_: None)
    imagined, real = np.ones(256, np.bool_), np.repeat([True, False], [195, 5])
    with pytest.raises(train_policy.ModelNotAcceptedError, match="could only lower this policy; keep this policy"):
        train_policy._judge(job, tmp_path, False, imagined, real)
    train_policy._judge(job, tmp_path, True, imagined, real)
    assert said == [
        "acceptance failed (room to learn: done precision, cloned policy - its real success 195/200), going on because "
        "of --force"
    ]


@pytest.mark.parametrize(
    "chosen",
    [{"from_scratch": False, "task": "push_cube"}, {"from_scratch": True, "world_model.object_reader_iterations": 0}],
)
def test_a_policy_that_would_see_nothing_is_refused_before_anything_is_collected(chosen: dict[str, Any]) -> None:
    from_scratch = chosen.pop("from_scratch")
    arguments: Any = SimpleNamespace(model_dir=None, from_scratch=from_scratch)
    config = load_config("scenes", {"task": "push", "device": "cpu", "policy.inputs": "state", **chosen})
    with pytest.raises(ValueError, match="take a model with an object reader"):
        train_policy._check(arguments, config)
