"""No module outside the simulator's room says what one scene, robot or simulator is: that comes from spec and task."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2] / "wm_nodes" / "wm_nodes"
SIMULATOR = "environments/maniskill/"
MAY_NAME_THE_SIMULATOR = {
    "environments/": "the room of simulators, robots and recordings of them",
    "apps/train_policy.py": "names the value of a setting",
}
"""Modules and folders whose text may hold `maniskill`, and why."""


def modules_with(text: str, *allowed: str) -> list[str]:
    """The package's modules whose text holds it in any case, without those of the allowed folders and files."""
    paths = sorted(ROOT.rglob("*.py"))
    assert len(paths) > 300, f"{ROOT} is not the package"
    names = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8").lower() for path in paths}
    return [name for name, content in names.items() if text.lower() in content and not name.startswith(allowed)]


@pytest.mark.parametrize("text", ["cube", "PROBE_NAMES", "TOOL_CENTER_M"])
def test_no_module_outside_the_simulator_knows_what_one_scene_holds(text: str) -> None:
    assert modules_with(text, SIMULATOR) == []


def test_only_modules_with_a_reason_name_the_simulator() -> None:
    assert modules_with("maniskill", *MAY_NAME_THE_SIMULATOR) == []


def test_every_reason_to_name_the_simulator_is_needed() -> None:
    named = modules_with("maniskill")
    assert [name for name in MAY_NAME_THE_SIMULATOR if not any(one.startswith(name) for one in named)] == []
