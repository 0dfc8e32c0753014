"""msgs_schema/README.md describes exactly the fields that the interface files have."""

import re
from pathlib import Path

FIELD = re.compile(r"^[\w/]+(?:\[\])?\s+(\w+(?:=\S+)?)")
ROW = re.compile(r"^\| `([^`]+)` \| `[^`]+` \|")


def documented(readme: str) -> dict[str, list[str]]:
    fields: dict[str, list[str]] = {}
    current: list[str] = []
    for line in readme.splitlines():
        if line.startswith("### "):
            current = fields.setdefault(line[4:].strip(), [])
        elif match := ROW.match(line):
            current.append(match[1])
    return fields


def test_every_field_of_every_interface_is_in_the_readme_in_order(repository: Path) -> None:
    folder = repository / "msgs_schema"
    files = [path for kind in ("msg", "srv", "action") for path in (folder / kind).glob(f"*.{kind}")]
    defined = {
        path.stem: [m[1] for line in path.read_text().splitlines() if (m := FIELD.match(line))] for path in files
    }
    assert documented((folder / "README.md").read_text()) == defined


def test_links_of_the_workspace_are_relative_and_lead_to_the_packages(repository: Path) -> None:
    for name, target in {"wm_msgs": "msgs_schema", "wm_nodes": "wm_nodes", "wm_bringup": "launch_scripts"}.items():
        link = repository / "ros2_ws" / "src" / name
        assert str(link.readlink()) == f"../../{target}"
        assert f"<name>{name}</name>" in (link / "package.xml").read_text()
