"""The pages that --help shows: what the verbs' parsers say, and what config/ says of each setting, kept as files beside
this one, so that nothing is imported or set up to read them. A test compares; `python -m wm_nodes.apps.help` writes
them anew. Standard library only.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

FOLDER = Path(__file__).parent
PROGRAM = "wm"
"""How the pages call the command."""
ASKED = ("-h", "--help")
SETTINGS = re.compile(r"one of the (\w+)\s+settings below")
"""What the page of a verb says that takes settings, see apps/options.py; theirs follows."""


def page_file(words: Sequence[str]) -> Path:
    """The file of a verb, or of one of its commands. words: e.g. benchmark, diversity."""
    return FOLDER / f"{'-'.join(words)}.txt"


def asked_page(verb: str, argv: Sequence[str], program: str) -> str | None:
    """The page that the arguments of a verb ask for; None where they ask for none, or there is no such page.

    Args:
        program: the words before the arguments, as they were typed.
    """
    before = next((argv[:index] for index, word in enumerate(argv) if word in ASKED), None)
    if before is None:
        return None
    words = verb.split()
    command = next((word for word in before if page_file([*words, word]).is_file()), None)
    file = page_file([*words, command] if command else words)
    if not file.is_file():
        return None
    page = file.read_text(encoding="utf-8").replace(f"{PROGRAM} {verb}", program, 1)
    settings = SETTINGS.search(page)
    return page + ("\n" + page_file(["settings", settings[1]]).read_text(encoding="utf-8") if settings else "")
