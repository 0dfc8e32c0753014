"""Comparing specs: each field that differs, and the remedy that fits."""

import json
from dataclasses import replace
from typing import Any

import pytest
from recording_samples import make_spec

from wm_nodes.core.specs import MODEL_FIELDS, SpecMismatch, agree, spec_of_values, spec_values, tool_spec

PICTURES, ROBOT, NUMBERS = "show the pictures", "it is another robot", "set actions, box and control period"


@pytest.mark.parametrize(
    ("changes", "said", "remedies"),
    [
        ({"height": 9}, ("height 9, the model needs 8",), (PICTURES,)),
        ({"cameras": ("top", "wrist")}, ("cameras ('top', 'wrist')",), (PICTURES,)),
        ({"action_scale": (0.1,) * 3}, ("action_scale (0.1, 0.1, 0.1)",), (NUMBERS,)),
        ({"state_names": ("a", "b", "c"), "width": 13}, ("state_names ('a', 'b', 'c')", "width 13"), (ROBOT,)),
        ({"control_period_s": 0.2, "width": 13}, ("control_period_s 0.2",), (PICTURES, NUMBERS)),
        ({"state_low": (0.0,) * 3}, ("state_low (0.0, 0.0, 0.0)",), (NUMBERS,)),
    ],
)
def test_specs_that_differ_are_refused_by_field_and_with_the_remedy_that_fits(
    changes: dict[str, Any], said: tuple[str, ...], remedies: tuple[str, ...]
) -> None:
    with pytest.raises(SpecMismatch) as refused:
        agree(make_spec(**changes), make_spec(), "the model needs", MODEL_FIELDS)
    text = str(refused.value)
    assert all(part in text for part in said), text
    assert {remedy for remedy in (PICTURES, ROBOT, NUMBERS) if remedy in text} == {*remedies}, text


def test_specs_agree_that_differ_in_what_nobody_depends_on_or_in_digits_that_are_not_sent() -> None:
    spec = make_spec()
    agree(replace(spec, env_id="other", num_envs=4, max_episode_steps=9), spec, "the model needs", MODEL_FIELDS)
    agree(replace(spec, action_scale=(0.05 + 1e-10,) * 3), spec, "the model needs")


def test_a_spec_comes_back_from_its_values_and_other_fields_are_refused() -> None:
    spec = make_spec()
    assert spec_of_values(json.loads(json.dumps(spec_values(spec)))) == spec
    with pytest.raises(ValueError, match=r"too many or missing: \['hight'\]"):
        spec_of_values(spec_values(spec) | {"hight": 1})


def test_a_value_is_measured_unless_its_name_says_target_and_the_task_s_code_is_neither() -> None:
    spec = make_spec(
        state_names=("target_x", "force", "task_reach"), state_units=("m", "N", "1"), state_low=(0.0, -1.0, 0.0),
        state_high=(1.0, 1.0, 1.0),
    )
    assert spec.measured == (1,) and spec.tool_dim == 2
    tool = tool_spec(replace(spec, num_envs=3))
    assert (tool.num_envs, tool.state_names, tool.state_high) == (1, ("target_x", "force"), (1.0, 1.0))
