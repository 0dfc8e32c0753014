"""Text files are read and written as UTF-8 whatever the user's locale is."""

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILES = [
    file for folder in ("wm_nodes", "launch_scripts", "tests") for file in sorted((ROOT / folder).rglob("*.py"))
    if not file.name.startswith("test_")
]
MODE_AT = {"open": 1, "os.fdopen": 1, "io.open": 1}
"""Position of the mode among the arguments; of a path's open() it is the first."""
NO_FILES_OF_TEXT = ("os.open", "Image.open", "self._reader.open")


def calls_without_encoding(source: str) -> Iterator[str]:
    """Calls that read or write text and leave its encoding to the locale."""
    for call in (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)):
        given = {word.arg: word.value for word in call.keywords}
        function = ast.unparse(call.func)
        name = function.rpartition(".")[2]
        if "encoding" in given or function in NO_FILES_OF_TEXT:
            continue
        if name in {"open", "fdopen"}:
            position = MODE_AT.get(function, 0)
            mode = given.get("mode") or (call.args[position] if len(call.args) > position else None)
            text = not (isinstance(mode, ast.Constant) and "b" in mode.value)
        elif name in {"run", "Popen", "check_output"}:
            text = bool({"text", "universal_newlines"} & {*given})
        else:
            text = len(call.args) < {"read_text": 1, "write_text": 2}.get(name, 0)
        if text:
            yield f"line {call.lineno}: {ast.unparse(call)}"


def test_every_text_file_is_opened_with_its_encoding() -> None:
    found = {str(file.relative_to(ROOT)): [*calls_without_encoding(file.read_text("utf-8"))] for file in FILES}
    assert {name: calls for name, calls in found.items() if calls} == {}


def test_a_call_that_leaves_the_encoding_to_the_locale_is_found() -> None:
    source = "a.read_text()\nopen(b, 'a')\nc.open()\nrun(d, text=True)\nopen(e, 'rb')\nf.read_text('utf-8')"
    assert [line.split(":")[0] for line in calls_without_encoding(source)] == ["line 1", "line 2", "line 3", "line 4"]


def test_the_audit_page_is_made_under_a_locale_that_is_not_utf8() -> None:
    code = "from wm_nodes.judge.audit.viewer import page; print(len(page('t', {})))"
    locale = {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run([sys.executable, "-c", code], env={**os.environ, **locale}, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode(errors="replace")
