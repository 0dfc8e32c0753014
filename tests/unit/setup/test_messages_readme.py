"""msgs_schema/README.md says what every field of every interface means, and READMEs link to what exists.

`python tests/unit/test_setup_messages_readme.py` writes the README's tables anew from the interface files.
"""

import re
from pathlib import Path

import pytest

KINDS = {"msg": "Messages", "srv": "Services", "action": "Actions"}
PARTS = {"msg": (), "srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}
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


def page(path: Path, kind: str) -> str:
    """One interface's section: its leading comment, then a row per field."""
    lines = path.read_text().splitlines()
    length = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    intro = " ".join(line.removeprefix("#").strip() for line in lines[:length])
    rows = ["| Field | Type | Meaning |", "| --- | --- | --- |"]
    for title, part in zip(PARTS[kind] or ("",), fields(path), strict=True):
        if title:
            rows.append(f"| **{title}** | | {'' if part else 'empty'} |")
        for name, type_name, meaning in part:
            rows.append(f"| `{name}` | `{type_name}` | " + meaning.replace("|", r"\|") + " |")
    return "\n\n".join(text for text in (f"### {path.stem}", intro, "\n".join(rows)) if text)


def tables(folder: Path) -> str:
    """All of the README from its heading "Messages" on."""
    sections = []
    for kind, title in KINDS.items():
        sections += [f"## {title}", *(page(path, kind) for path in interfaces(folder, kind))]
    return "\n\n".join(sections) + "\n"


def test_the_readme_is_what_the_interface_files_say(repository: Path) -> None:
    folder = repository / "msgs_schema"
    text = (folder / "README.md").read_text()
    assert text[text.index("## Messages") :] == tables(folder), "run python tests/unit/test_setup_messages_readme.py"


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


if __name__ == "__main__":
    schema = Path(__file__).resolve().parents[3] / "msgs_schema"
    readme = schema / "README.md"
    old = readme.read_text()
    readme.write_text(old[: old.index("## Messages")] + tables(schema))
