"""The full tables of the result pages as files, and whether those files are up to date."""

from dataclasses import dataclass, field
from pathlib import Path

import yaml

from benchmarks.experiment import NO_OPTION, Experiment, console
from benchmarks.tables.pictures import draw_tasks
from benchmarks.tables.table import DOCS, section
from wm_nodes.core.files import write_atomic

HEAD = """# Full tables of [{page}.md](../{page}.md)

Written by `wm benchmark tables` from the result files; do not edit. Intervals are of 95 %; bold ones exclude 0.
[Metrics](../../metrics.md). `wm` is `python3 launch_scripts/wm.py`. Recorded commands have the names of their day.

"""


@dataclass(kw_only=True)
class Tables(Experiment):
    """Write the full tables and a picture of docs/results from the result files; --check compares the tables."""

    json: Path | None = field(default=None, metadata=NO_OPTION)
    """None: the files are there."""
    check: bool = False
    """Write nothing, and name the tables that are out of date; exit code 1 if there are any."""
    docs: Path = DOCS
    """Folder of the documents: tables are in results/tables, the picture in images."""

    def run(self) -> int:
        texts = {self.docs / "results" / "tables" / f"{page}.md": text for page, text in page_texts().items()}
        if not self.check:
            for file, text in texts.items():
                write_atomic(file, text.encode())
            draw_tasks(self.docs / "images" / "policy_rl_tasks.png")
        stale = [f"{file.name}: {title}" for file, text in texts.items() for title in differing(file, text)]
        console.print("\n".join(["out of date, wm benchmark tables writes:", *stale]) if stale else "up to date")
        return int(bool(stale))


def page_texts() -> dict[str, str]:
    """All tables of each page, by its name."""
    pages = yaml.safe_load(Path(__file__).with_name("pages.yaml").read_text(encoding="utf-8"))
    return {page: HEAD.format(page=page) + "\n".join(section(page, **one) for one in tables)
            for page, tables in pages.items()}


def differing(file: Path, text: str) -> list[str]:
    """The titles of the tables that a file lacks, has otherwise or has too many."""
    parts = [
        {part.partition("\n")[0]: part.strip() for part in content.split("\n## ")}
        for content in (text, file.read_text(encoding="utf-8") if file.is_file() else "")
    ]
    return [title for title in dict.fromkeys([*parts[0], *parts[1]]) if parts[0].get(title) != parts[1].get(title)]
