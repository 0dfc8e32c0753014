"""The version stands in wm_nodes/__init__.py; what ROS, GitHub and readers need is a copy that says the same."""

import re
from pathlib import Path

import pytest
import yaml

from wm_nodes import __version__


@pytest.mark.parametrize("package", ["wm_nodes", "msgs_schema", "launch_scripts"])
def test_a_package_has_the_version(repository: Path, package: str) -> None:
    text = (repository / package / "package.xml").read_text(encoding="utf-8")
    assert re.findall("<version>(.+)</version>", text) == [__version__]


def test_the_newest_change_is_of_the_version(repository: Path) -> None:
    text = (repository / "wm_nodes" / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (\S+)", text, re.MULTILINE)[0] == __version__


def test_setup_py_and_other_code_do_not_repeat_it(repository: Path) -> None:
    files = [repository / "wm_nodes" / "setup.py", *(repository / "wm_nodes" / "wm_nodes").rglob("*.py")]
    assert [path.name for path in files if f'"{__version__}"' in path.read_text(encoding="utf-8")] == ["__init__.py"]


def test_the_citation_has_what_the_format_asks_for(repository: Path) -> None:
    """https://github.com/citation-file-format/citation-file-format/blob/1.2.0/schema-guide.md"""
    cited = yaml.safe_load((repository / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited["cff-version"] == "1.2.0" and cited["message"] and cited["title"] and cited["type"] == "software"
    assert cited["version"] == __version__ and cited["license"] == "Apache-2.0"
    assert all({*author} & {"name", "family-names", "given-names", "alias"} for author in cited["authors"])
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", cited["date-released"])
