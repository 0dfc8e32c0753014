"""Scalars of a run: one JSON object a line, and TensorBoard, in the run folder."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from wm_nodes.core.files import open_to_append, text_lines, write_atomic

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

FILE_NAME = "metrics.jsonl"


class MetricsWriter:
    """Appends to <run_dir>/metrics.jsonl and <run_dir>/tensorboard; a resumed run goes on in the same files.

    A value that is not finite is written as null: JSON has no NaN, and nothing turns it into 0.
    tensorboard=False saves its import, which takes seconds; it is imported at the first write.
    """

    def __init__(self, run_dir: Path, *, tensorboard: bool = True) -> None:
        run_dir.mkdir(parents=True, exist_ok=True)
        self._folder = run_dir / "tensorboard" if tensorboard else None
        self._file = open_to_append(run_dir / FILE_NAME)
        self._board: SummaryWriter | None = None

    def write(self, section: str, step: int, scalars: Mapping[str, float]) -> None:
        """Write scalars of one step, e.g. write("ppo", 3, {"loss_policy": 0.1}); flushed at once."""
        numbers = {name: float(value) for name, value in scalars.items()}
        line = {"section": section, "step": step}
        line |= {name: value if math.isfinite(value) else None for name, value in numbers.items()}
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()
        if self._folder is not None:
            if self._board is None:
                from torch.utils.tensorboard import SummaryWriter

                self._board = SummaryWriter(str(self._folder))  # type: ignore[no-untyped-call]
            for name, value in numbers.items():
                if math.isfinite(value):
                    self._board.add_scalar(f"{section}/{name}", value, step)  # type: ignore[no-untyped-call]

    def close(self) -> None:
        self._file.close()
        if self._board is not None:
            self._board.close()  # type: ignore[no-untyped-call]


def join_metrics(folders: Sequence[Path], run_dir: Path) -> None:
    """Write <run_dir>/metrics.jsonl from those of consecutive trainings, their steps counted on."""
    lines, offset = list[str](), 0
    for folder in folders:
        steps = [offset]
        for line in read_metrics(folder):
            steps.append(offset + int(str(line["step"])))
            lines.append(json.dumps({**line, "step": steps[-1]}))
        offset = max(steps)
    write_atomic(run_dir / FILE_NAME, "".join(f"{line}\n" for line in lines).encode())


def read_metrics(run_dir: Path, section: str | None = None) -> list[dict[str, object]]:
    """Return the lines of metrics.jsonl in order, of one section or all; a last line cut by a crash is left out."""
    lines = []
    for text in text_lines((run_dir / FILE_NAME).read_bytes()):
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue
        if section is None or line["section"] == section:
            lines.append(line)
    return lines
