"""The documents for newcomers: short, with links that lead somewhere, refusals in the words that the code prints."""

import re
import sys
from pathlib import Path

import pytest
import yaml
from unit.docs.test_results import LINK, words

ROOT = Path(__file__).parents[3]
DOCS = ROOT / "wm_nodes" / "docs"
CODE = (ROOT / "wm_nodes" / "wm_nodes", ROOT / "launch_scripts")
MOST_WORDS = {
    "README.md": 900, "wm_nodes/docs/architecture.md": 700, "wm_nodes/docs/glossary.md": 400,
    "wm_nodes/docs/tutorial.md": 1000, "wm_nodes/docs/troubleshooting.md": 600,
}
GENERATED = DOCS / "results" / "tables"
QUOTE = re.compile(r"^```text\n(.+?)\n```$", re.MULTILINE | re.DOTALL)


def documents() -> list[Path]:
    """Every page that is written by hand."""
    folders = ("wm_nodes", "msgs_schema", "requirements", ".github")
    pages = [ROOT / "README.md", *(page for folder in folders for page in (ROOT / folder).rglob("*.md"))]
    return [page for page in pages if GENERATED not in page.parents]


@pytest.mark.parametrize("page", MOST_WORDS)
def test_a_page_for_newcomers_is_short(page: str) -> None:
    assert words(ROOT / page) <= MOST_WORDS[page]


def test_all_documents_together_stay_below_22_000_words() -> None:
    """As `wc -w` counts them; tables that a command writes are left out."""
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in documents()) <= 22_000


def test_links_of_documents_lead_somewhere() -> None:
    dead = [
        f"{page.relative_to(ROOT)}: {target}" for page in documents() for target in LINK.findall(page.read_text())
        if ":" not in target and not target.startswith("#") and not (page.parent / target.split("#")[0]).exists()
    ]
    assert not dead


def test_a_quoted_refusal_is_what_one_module_says() -> None:
    quotes = QUOTE.findall((DOCS / "troubleshooting.md").read_text(encoding="utf-8"))
    modules = [spoken(path.read_text(encoding="utf-8")) for folder in CODE for path in folder.rglob("*.py")]
    assert len(quotes) == 10
    missing = [quote for quote in quotes if not any(says(module, quote) for module in modules)]
    assert not missing


def spoken(source: str) -> str:
    """Source with texts that are broken over lines joined, so that each is found whole."""
    return re.sub(r"\"\s*\n\s*f?\"", "", source)


def says(module: str, quote: str) -> bool:
    return all(part in module for part in quote.split("…"))


def test_a_refusal_in_other_words_is_noticed() -> None:
    module = spoken('raise ValueError(f"{name} is gone; "\n    f"name another than {name}")')
    assert says(module, "… is gone; name another than …")
    assert not says(module, "… is gone; name one than …")


def test_pre_commit_runs_the_checks_of_run_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [str(ROOT / "launch_scripts"), *sys.path])
    from run_tests import CHECKS

    (local,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    entries = {hook["entry"].removeprefix(".venv/bin/") for hook in local["hooks"]}
    assert entries == {" ".join(command).removesuffix(" .") for command in CHECKS.values()}
    assert {hook["language"] for hook in local["hooks"]} == {"system"}
