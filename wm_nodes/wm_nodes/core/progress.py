"""tqdm's progress bar, which becomes a line now and then where the output is no terminal but, say, a file."""

import sys
from typing import Any, TextIO

import tqdm as bars

LINE_S = 30.0
"""Between two lines of one bar."""


class tqdm(bars.tqdm):  # type: ignore[type-arg]
    """A tqdm with the same arguments."""

    def __init__(self, *args: Any, **options: Any) -> None:
        file = options.get("file") or sys.stderr
        self._in_lines = not file.isatty()
        if self._in_lines:
            lines = {"file": _Lines(file), "mininterval": LINE_S, "maxinterval": LINE_S, "ascii": True}
            options = {"disable": False, **options, **lines}
        super().__init__(*args, **options)

    def set_postfix(self, ordered_dict: Any = None, refresh: bool | None = True, **values: Any) -> None:
        super().set_postfix(ordered_dict, refresh and not self._in_lines, **values)  # else a line for each call

    def set_postfix_str(self, s: str = "", refresh: bool = True) -> None:
        super().set_postfix_str(s, refresh and not self._in_lines)


class _Lines:
    """A file for tqdm that gets whole lines and none of what moves a terminal's cursor."""

    def __init__(self, file: TextIO) -> None:
        self._file, self.encoding = file, "utf-8"

    def write(self, text: str) -> None:
        if line := text.replace("\x1b[A", "").strip():
            self._file.write(f"{line}\n")

    def flush(self) -> None:
        self._file.flush()
