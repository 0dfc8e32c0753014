"""msgs_schema/README.md has every interface with its QoS; interface files explain every field; links lead somewhere."""

import re
from pathlib import Path

import pytest
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from wm_nodes.ros.qos import TOPICS

KINDS = ("msg", "srv", "action")
FIELD = re.compile(r"^([\w/]+(?:\[\])?)\s+(\w+(?:=\S+)?)\s*(?:#\s*(.*))?$")
LINK = re.compile(r"\]\(([^)\s]+)\)")
NOT_OURS = {".venv", ".git", "runs", "build", "install", "log", "node_modules"}


def interfaces(folder: Path, kind: str) -> list[Path]:
    return sorted((folder / kind).glob(f"*.{kind}"))


def fields(path: Path) -> list[list[tuple[str, str, str]]]:
    """(name, type, meaning) of every field and constant; one list per part, divided by `---`."""
    parts: list[list[tuple[str, str, str]]] = [[]]
    for line in path.read_text().splitlines():
        if line.strip() == "---":
            parts.append([])
        elif line.strip() and not line.startswith("#"):
            match = FIELD.match(line)
            assert match is not None, f"{path.name}: cannot read {line!r}"
            parts[-1].append((match[2], match[1], (match[3] or "").strip()))
    return parts


def table(repository: Path) -> list[list[str]]:
    """Cells of the README's table, a row per interface."""
    lines = (repository / "msgs_schema" / "README.md").read_text().splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    return rows[2:]


@pytest.mark.parametrize("kind", KINDS)
def test_every_interface_file_is_in_the_table(repository: Path, kind: str) -> None:
    named = {word for row in table(repository) for word in re.findall(r"\b[A-Z]\w+", row[1])}
    assert {path.stem for path in interfaces(repository / "msgs_schema", kind)} <= named


def qos_text(qos: QoSProfile) -> str:
    """The README's words for a profile."""
    words = [str(qos.depth) if qos.history is HistoryPolicy.KEEP_LAST else "all"]
    words += ["latched"] if qos.durability is DurabilityPolicy.TRANSIENT_LOCAL else []
    words += ["best effort"] if qos.reliability is ReliabilityPolicy.BEST_EFFORT else []
    return ", ".join(words)


def test_the_table_has_every_topic_with_its_type_and_qos(repository: Path) -> None:
    listed = {row[0].strip("`"): row for row in table(repository)}
    for name, row in TOPICS.items():
        package = row.type.__module__.split(".")[0]
        kind = row.type.__name__ if package == "wm_msgs" else f"{package}/{row.type.__name__}"
        assert (listed[name][1], listed[name][5]) == (kind, qos_text(row.qos)), name


@pytest.mark.parametrize("kind", KINDS)
def test_every_field_has_a_meaning(repository: Path, kind: str) -> None:
    unexplained = [
        f"{path.name}: {name}"
        for path in interfaces(repository / "msgs_schema", kind)
        for part in fields(path)
        for name, _, meaning in part
        if not meaning
    ]
    assert not unexplained


def test_every_relative_link_of_a_readme_leads_somewhere(repository: Path) -> None:
    readmes = [
        path
        for path in repository.rglob("README.md")
        if not NOT_OURS.intersection(path.relative_to(repository).parts) and not path.is_symlink()
    ]
    assert repository / "README.md" in readmes
    dead = [
        f"{path.relative_to(repository)}: {target}"
        for path in readmes
        for target in LINK.findall(path.read_text())
        if ":" not in target and not target.startswith("#") and not (path.parent / target.split("#")[0]).exists()
    ]
    assert not dead


def test_links_of_the_workspace_are_relative_and_lead_to_the_packages(repository: Path) -> None:
    for name, target in {"wm_msgs": "msgs_schema", "wm_nodes": "wm_nodes", "wm_bringup": "launch_scripts"}.items():
        link = repository / "ros2_ws" / "src" / name
        assert str(link.readlink()) == f"../../{target}"
        assert f"<name>{name}</name>" in (link / "package.xml").read_text()

