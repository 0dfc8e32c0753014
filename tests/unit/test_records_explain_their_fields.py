"""Every record of three or more public fields explains each of them by a string under it."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2] / "wm_nodes"
BASES = ("NamedTuple", "TypedDict", "Model", "Section", "Config")
"""How the names of a record's base classes end; a dataclass is known by its decorator."""


def is_record(node: ast.ClassDef) -> bool:
    """Whether the class is a dataclass, a NamedTuple, a TypedDict, a pydantic model or a section of settings."""
    bases = [ast.unparse(base) for base in node.bases]
    decorators = [ast.unparse(decorator) for decorator in node.decorator_list]
    return any("dataclass" in text for text in decorators) or any(base.endswith(BASES) for base in bases)


def public_field(node: ast.stmt) -> str:
    """Name of the public field that the statement declares; empty where it declares none."""
    if not isinstance(node, ast.AnnAssign) or "ClassVar" in ast.unparse(node.annotation):
        return ""
    name = ast.unparse(node.target)
    return "" if name.startswith("_") else name


def is_text(node: ast.stmt | None) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def unexplained_fields(record: ast.ClassDef) -> list[str]:
    """Names of the public fields without a string under them; none where the record has fewer than three fields."""
    fields = {
        name: is_text(below) for node, below in zip(record.body, [*record.body[1:], None], strict=True)
        if (name := public_field(node))
    }
    return [name for name, explained in fields.items() if not explained] if len(fields) >= 3 else []


def records_lacking(source: str) -> dict[str, list[str]]:
    """Unexplained fields by the name of the record, for the records that have any."""
    records = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef) and is_record(node))
    return {record.name: fields for record in records if (fields := unexplained_fields(record))}


def test_a_field_without_an_explanation_is_named() -> None:
    fields = ["    x: int", '    """Of the tool, px."""', "    y: int", "    z: int = 0", "    _hidden: int = 0"]
    explained = [*fields[:3], fields[1], fields[3], fields[1], fields[4]]
    for head in ("@dataclass(frozen=True)\nclass Point:", "class Point(NamedTuple):", "class Point(SettingsSection):"):
        assert records_lacking("\n".join([head, *fields])) == {"Point": ["y", "z"]}
        assert records_lacking("\n".join([head, *explained])) == {}
        assert records_lacking("\n".join([head, *fields[2:]])) == {}, "two public fields need no explanation"


def test_every_record_explains_its_fields() -> None:
    lacking = [
        f"{path.relative_to(ROOT)}: {name}: {', '.join(fields)}"
        for package in ("wm_nodes", "benchmarks") for path in sorted((ROOT / package).rglob("*.py"))
        for name, fields in records_lacking(path.read_text(encoding="utf-8")).items()
    ]
    assert not lacking, "fields without a string under them:\n" + "\n".join(lacking)
