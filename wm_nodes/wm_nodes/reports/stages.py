"""What a command says while it works."""

import time

from rich.console import Console

console = Console()


class Stages:
    """Prints what is being done, with the minutes since the start."""

    def __init__(self) -> None:
        self._started = time.monotonic()

    @property
    def minutes(self) -> float:
        return (time.monotonic() - self._started) / 60

    def __call__(self, text: str) -> None:
        minutes, seconds = divmod(int(60 * self.minutes), 60)
        console.print(f"[dim]{minutes:3d}:{seconds:02d}[/] {text}", highlight=False)
