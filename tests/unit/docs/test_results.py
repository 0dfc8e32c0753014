"""The full tables are what `wm benchmark tables` makes of the result files, and the result pages quote them."""

import re
import shutil
from pathlib import Path

import pytest

import wm_nodes
from wm_nodes.apps.cli import main

ROOT = Path(wm_nodes.__file__).parents[1]
DOCS, FILES = ROOT / "docs", ROOT / "benchmarks" / "results"
TABLES = DOCS / "results" / "tables"
GUIDES = ("README", "audit", "embedded_judge", "model_refresh", "public_video_models")
QUOTING = {page: TABLES / page.name for page in sorted((DOCS / "results").glob("*.md"))} | {
    DOCS / "devices.md": TABLES / "speed.md"
}
"""Hand-written pages, and the tables from which they quote; of devices.md the part under "Measured"."""
LINK = re.compile(r"\]\(([^)\s]+)\)")
DECIMAL = re.compile(r"\d[\d,]*\.\d+")


def test_the_full_tables_are_what_the_result_files_hold(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "tables", "--check"]) == 0, capsys.readouterr().out


def test_a_table_that_is_not_what_its_file_holds_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(TABLES, tmp_path / "results" / "tables")
    changed = tmp_path / "results" / "tables" / "speed.md"
    changed.write_text(changed.read_text().replace("| 715 |", "| 815 |"))
    assert main(["benchmark", "tables", "--check", "--docs", str(tmp_path)]) == 1
    assert capsys.readouterr().out.splitlines()[1:] == ["speed.md: Graph and imagination"]


@pytest.mark.parametrize("page", QUOTING, ids=lambda page: page.stem)
def test_every_row_and_every_decimal_number_of_a_result_page_stands_in_its_full_tables(page: Path) -> None:
    quoted, full = page.read_text().split("## Measured")[-1], QUOTING[page].read_text()
    known = [set(row) for row in rows(full)]
    numbers = ({cell for cell in row if re.search(r"\d", cell)} for row in rows(quoted))
    assert not [row for row in numbers if not any(row <= other for other in known)]
    assert set(DECIMAL.findall(quoted)) <= set(DECIMAL.findall(full))


def test_a_result_page_asks_at_most_four_questions_and_answers_each_in_at_most_five_rows() -> None:
    for page in (DOCS / "results").glob("*.md"):
        _, *questions = page.read_text().split("\n## ")
        assert len(questions) <= 4, page
        assert not [part for part in questions if not part.splitlines()[0].endswith("?") or len(rows(part)) > 5]


def rows(text: str) -> list[list[str]]:
    """The cells of all rows of all tables below their heads."""
    body = re.sub(r"^\|.*\|\n\|[ |-]*\|$", "", text, flags=re.MULTILINE)
    return [re.split(r"\s*\|\s*", line)[1:-1] for line in body.splitlines() if line.startswith("|")]


def test_every_result_file_is_linked_from_a_page_and_every_relative_link_of_a_document_leads_somewhere() -> None:
    targets = {
        (page, (page.parent / target.split("#")[0]).resolve())
        for page in DOCS.rglob("*.md")
        for target in LINK.findall(page.read_text())
        if ":" not in target and not target.startswith("#")
    }
    assert not [(str(page), str(target)) for page, target in targets if not target.exists()]
    linked = {target for _, target in targets}
    assert not [path.name for path in FILES.iterdir() if path.suffix != ".md" and path.resolve() not in linked]


def words(*pages: Path) -> int:
    """Words and numbers of hand-written pages, which the full tables are not; a table's bars and dashes are none."""
    return sum(len(re.findall(r"\S*\w\S*", page.read_text())) for page in pages)


def test_documents_are_short() -> None:
    results, guides = sorted((DOCS / "results").glob("*.md")), [DOCS / f"{name}.md" for name in GUIDES]
    assert not [page.name for page in results if words(page) > 500]
    assert words(*results) <= 3250
    assert words(*guides) <= 1900
    assert words(DOCS / "audit.md") <= 900
    assert words(DOCS / "README.md") <= 250
    assert words(*(DOCS / "adr").glob("*.md")) <= 900
