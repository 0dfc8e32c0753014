"""`python -m wm_nodes.apps.help`: write the pages anew, from the parsers of the verbs."""

import argparse
import os
from collections.abc import Iterator

from wm_nodes.apps.cli import VERBS, parser_of
from wm_nodes.apps.help import FOLDER, PROGRAM, page_file

COLUMNS = "102"
"""$COLUMNS, by which argparse makes pages of 100 characters."""


def pages() -> dict[str, str]:
    """The text of every page by the name of its file, as wide as $COLUMNS says."""
    return {page_file(parser.prog.split()[1:]).name: parser.format_help()
            for verb in VERBS for parser in _with_commands(parser_of(verb, f"{PROGRAM} {verb}"))}


def _with_commands(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from action.choices.values()


if __name__ == "__main__":
    os.environ["COLUMNS"] = COLUMNS
    for file in FOLDER.glob("*.txt"):
        file.unlink()
    for name, text in pages().items():
        (FOLDER / name).write_text(text, encoding="utf-8")
