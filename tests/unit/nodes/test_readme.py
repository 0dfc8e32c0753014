"""The nodes' README lists each node's parameters with the default and unit that the node declares."""

import importlib
import re
from pathlib import Path

import pytest

from wm_nodes import nodes
from wm_nodes.ros.params import COMMON, Param

FOLDER = Path(nodes.__file__).parent
MODULES = sorted(path.stem for path in FOLDER.glob("*_node.py"))
ROW = re.compile(r"^\| (`\w+`(?:, `\w+`)*) \| ?(.*?) ?\| .*\|$")
EVERY_NODE = "Nodes"
"""The heading over the table of parameters that exist everywhere."""


def tables() -> dict[str, list[tuple[str, str]]]:
    """Heading to (parameter, text of its default) in order; a row may name several parameters."""
    found: dict[str, list[tuple[str, str]]] = {}
    rows: list[tuple[str, str]] = []
    for line in (FOLDER / "README.md").read_text().splitlines():
        if heading := re.match(r"^#+ (.+)$", line):
            rows = found.setdefault(heading[1], [])
        elif match := ROW.match(line):
            rows += [(name.strip("`"), match[2]) for name in match[1].split(", ")]
    return found


def shown(param: Param) -> str:
    """The default as the README has it, with its unit."""
    default = param.default
    if isinstance(default, bool):
        return str(default).lower()
    if isinstance(default, list):
        return f"[{', '.join(filter(None, default))}]"
    if isinstance(default, (int, float)):
        return f"{default:g} {param.unit}".strip()
    return default


def plain(text: str) -> str:
    """`text` with its number, where it begins with one, in the shortest form: 1.0 s and 1 s are the same."""
    number = re.match(r"^-?\d+(?:\.\d+)?(?= |$)", text)
    return f"{float(number[0]):g}{text[number.end() :]}" if number else text


def wrong(rows: list[tuple[str, str]], params: tuple[Param, ...]) -> list[str]:
    """One line per parameter that is missing, listed twice, unknown, or has another default or unit."""
    names, declared = [name for name, _ in rows], {param.name: shown(param) for param in params}
    lines = [f"{name} has no row" for name in declared if name not in names]
    lines += [f"{name} has {names.count(name)} rows" for name in sorted(set(names)) if names.count(name) > 1]
    for name, text in rows:
        if name not in declared:
            lines.append(f"{name} is no parameter")
        elif plain(text) != plain(declared[name]):
            lines.append(f"{name} is {declared[name]!r}, the README says {text!r}")
    return lines


def test_a_row_without_its_unit_or_with_another_default_is_wrong() -> None:
    params = (Param("a_s", 0.5, "", "s"), Param("b", True, ""), Param("c", ["x", ""], ""))
    assert not wrong([("a_s", "0.50 s"), ("b", "true"), ("c", "[x]")], params)
    assert wrong([("a_s", "0.5"), ("b", "false"), ("d", "")], params) == [
        "c has no row", "a_s is '0.5 s', the README says '0.5'", "b is 'true', the README says 'false'",
        "d is no parameter",
    ]


@pytest.mark.parametrize("module", MODULES)
def test_every_node_has_a_table_of_its_parameters(module: str) -> None:
    params = importlib.import_module(f"wm_nodes.nodes.{module}").PARAMS
    assert not wrong(tables().get(module.removesuffix("_node"), []), params)


def test_the_parameters_of_every_node_have_a_table() -> None:
    rows = [(name, "" if text == "required" else text) for name, text in tables()[EVERY_NODE]]
    assert not wrong(rows, COMMON)
