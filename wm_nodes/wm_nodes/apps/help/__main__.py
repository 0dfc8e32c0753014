"""`python -m wm_nodes.apps.help`: write the pages anew, from the parsers of the verbs and what config/ explains."""

import argparse
import json
import os
import textwrap
from collections.abc import Iterator

from wm_nodes.apps.cli import VERBS, parser_of
from wm_nodes.apps.help import FOLDER, PROGRAM, page_file
from wm_nodes.apps.help.explanations import explanations
from wm_nodes.apps.options import JUDGE
from wm_nodes.config.load import POLICY, VIDEO, load_config, load_video_config
from wm_nodes.config.sections import SettingsSection

COLUMNS = "102"
"""$COLUMNS, by which argparse makes pages of 100 characters."""


def pages() -> dict[str, str]:
    """The text of every page by the name of its file, as wide as $COLUMNS says."""
    video = load_video_config()
    settings = {
        POLICY: settings_page("settings of loop 1, with the values of preset cpu", load_config()),
        VIDEO: settings_page("settings of loop 2, with the values of preset recommended", video),
        JUDGE: settings_page("settings of the judge, with their values in every preset", video.judge, "judge."),
    }
    verbs = {page_file(parser.prog.split()[1:]).name: parser.format_help()
             for verb in VERBS for parser in _with_commands(parser_of(verb, f"{PROGRAM} {verb}"))}
    return verbs | {page_file(["settings", name]).name: text for name, text in settings.items()}


def settings_page(title: str, settings: SettingsSection, path: str = "") -> str:
    """Every setting below a section, by its name, with its value and its explanation."""
    return "\n".join([f"{title}:", *_settings_lines(settings, path), ""])


def _settings_lines(settings: SettingsSection, path: str) -> Iterator[str]:
    about = explanations(type(settings))
    for name in type(settings).model_fields:
        value = getattr(settings, name)
        if isinstance(value, SettingsSection):
            yield from ["", *textwrap.wrap(f"{path}{name}: {_one_line(type(value).__doc__)}", int(COLUMNS) - 2)]
            yield from _settings_lines(value, f"{path}{name}.")
        else:
            yield f"  --{path}{name} {json.dumps(value)}"
            yield from textwrap.wrap(
                about.get(name, ""), int(COLUMNS) - 2, initial_indent=" " * 8, subsequent_indent=" " * 8
            )


def _one_line(text: str | None) -> str:
    return " ".join((text or "").split())


def _with_commands(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from action.choices.values()


if __name__ == "__main__":
    os.environ["COLUMNS"] = COLUMNS
    made = pages()
    for file in FOLDER.glob("*.txt"):
        file.unlink()
    for name, text in made.items():
        (FOLDER / name).write_text(text, encoding="utf-8")
