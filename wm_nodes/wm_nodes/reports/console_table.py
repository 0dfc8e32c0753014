"""One way to build a table for the terminal, and to write shares, numbers and intervals in its cells."""

from collections.abc import Collection, Iterable, Sequence

from rich.table import Table


def make_table(
    title: str | None, columns: Sequence[str], rows: Iterable[Sequence[object]] = (), *,
    left: Collection[str] | None = None, caption: str | None = None, no_wrap: Collection[str] = (),
) -> Table:
    """Build a table; columns of text are aligned left, columns of numbers right. left: names of the columns of text;
    None: only the first column. no_wrap: names of the columns whose cells stay on one line.
    """
    table = Table(title=title, caption=caption)
    for name in columns:
        is_text = name in (columns[:1] if left is None else left)
        table.add_column(name, justify="left" if is_text else "right", no_wrap=name in no_wrap)
    for row in rows:
        table.add_row(*map(str, row))
    return table


def percent(share: float) -> str:
    """A share in percent with one digit; "-" for NaN."""
    return "-" if share != share else f"{100 * share:.1f}"


def percent_interval(low: float, high: float) -> str:
    return f"{100 * low:.1f} to {100 * high:.1f}"


def decimal(value: float) -> str:
    """A number with three digits; "-" for NaN."""
    return "-" if value != value else f"{value:.3f}"


def estimate(values: Sequence[float], form: str = "+.4f") -> str:
    """(mean, low, high) as "mean (low to high)", each in this format."""
    mean, low, high = (format(value, form) for value in values)
    return f"{mean} ({low} to {high})"
