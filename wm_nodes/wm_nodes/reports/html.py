"""report.html: everything about one run in one file without outside parts, readable on light and dark screens.

The pages are in templates/, where every value is escaped unless it is Markup.
"""

import base64
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from wm_nodes.core.files import write_atomic
from wm_nodes.reports import tables
from wm_nodes.reports.summary import Summary, acceptance_outcome

FILE_NAME = "report.html"
MARK = Markup('<span class="{}">{}</span>')
"""A word in the colour of its CSS class: good, bad or faint."""
MARKS = {"passed": "good", "failed": "bad", "undecided": "faint"}
"""CSS class of each outcome of a criterion."""


@dataclass(frozen=True)
class Picture:
    """A PNG or GIF of the report."""

    title: str
    """Above it."""
    caption: str
    """What one sees in it."""
    path: Path
    """Of the file."""


def write_report(
    run_dir: Path, summary: Summary, pictures: Sequence[Picture] = (), *, config_text: str = "", again: str = ""
) -> Path:
    """Write <run_dir>/report.html and return its path. Raises FileNotFoundError: a picture does not exist.

    Args:
        again: the command that trains from the bag to the same weights; empty: none does.
    """
    results = (
        (row.label, *(text for c in (row.real, row.imagined)
                      for text in (c.count, c.percent, c.interval.removeprefix("95 %: "))))
        for row in tables.result_rows(summary)
    )
    return write_page(
        "policy.html", run_dir, summary, pictures, config_text,
        title=f"{summary.task}: a policy trained inside a world model", verdict=tables.verdict(summary),
        results=results, tables=tables, again=again, **_acceptance(summary.acceptance),
    )


def write_page(
    template: str, run_dir: Path, summary: Any, pictures: Sequence[Picture], config_text: str, **values: Any
) -> Path:
    """Write <run_dir>/report.html from a template and return its path. Raises FileNotFoundError: a picture does not
    exist."""
    loader = PackageLoader("wm_nodes.reports")
    pages = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, keep_trailing_newline=True
    )
    pages.filters |= {"base64": _base64, "quoted": lambda path: shlex.quote(str(path))}
    page = pages.get_template(template).render(
        run_dir=run_dir, summary=summary, pictures=pictures, config_text=config_text, **values
    )
    path = Path(run_dir) / FILE_NAME
    write_atomic(path, page.encode())
    return path


def _base64(picture: Picture) -> str:
    if not picture.path.is_file():
        raise FileNotFoundError(f"picture {picture.path} of the report does not exist")
    return base64.b64encode(picture.path.read_bytes()).decode()


def _acceptance(report: Mapping[str, Any]) -> dict[str, Any]:
    if not report:
        return {}
    words = {"failed": "Failed: trained in it all the same", "undecided": "Undecided: too few episodes"}
    return {
        "outcome": words.get(acceptance_outcome(report), "Passed"),
        "criteria": map(_criterion, report["criteria"]),
        "metrics": [(name, _value(value)) for name, value in report.get("metrics", {}).items()],
    }


def _criterion(criterion: Mapping[str, Any]) -> Iterable[str]:
    outcome = acceptance_outcome(criterion)
    why = {"failed": f": {criterion['remedy']}", "undecided": ": too few episodes"}.get(outcome, "")
    interval = " to ".join(f"{end:.2f}" for end in criterion.get("interval") or ())
    threshold = "" if criterion["threshold"] is None else f"{float(criterion['threshold']):g}"
    rule = f"{criterion['rule']} {threshold}"
    return criterion["name"], _value(criterion["value"]), interval, rule, MARK.format(MARKS[outcome], outcome) + why


def _value(value: Any) -> str:
    return "undefined" if value is None else f"{float(value):.3f}"
