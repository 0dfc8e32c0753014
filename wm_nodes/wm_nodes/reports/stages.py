"""What a command says while it works."""

import time
from pathlib import Path

from rich.console import Console
from rich.markup import escape

console = Console()


class Stages:
    """Prints what is being done, with the minutes since the start."""

    def __init__(self) -> None:
        self._started = time.monotonic()

    @property
    def minutes(self) -> float:
        return (time.monotonic() - self._started) / 60

    def __call__(self, text: str) -> None:
        """Print the text as it is: brackets in a path are no style, and it stays on one line."""
        minutes, seconds = divmod(int(60 * self.minutes), 60)
        console.print(f"[dim]{minutes:3d}:{seconds:02d}[/] {escape(text)}", highlight=False, soft_wrap=True)


def say_files(report: Path, summary: Path, bag: str) -> None:
    """Print where a run's results are, each path whole and on one line."""
    text = f"report   {report}\nsummary  {summary}\nbag      {bag}"
    console.print(text, highlight=False, markup=False, soft_wrap=True)
