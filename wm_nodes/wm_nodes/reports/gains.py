"""Mean gain of one way of training over another, from a table of success rates, as RoboScape-R reports it."""

from collections.abc import Mapping

Cell = tuple[str, str, str]
"""Policy, training, task."""


def mean_gain(rates: Mapping[Cell, float], training: str, baseline: str) -> float:
    """Mean over policies and tasks of rate(training) - rate(baseline), in the unit of the rates.

    Args:
        rates: a success rate for each cell. What only one of the two trainings has been measured on is an error.

    Raises:
        ValueError: a cell that only one of the two trainings has, or none at all.
    """
    names = {name: {(policy, task) for policy, other, task in rates if other == name} for name in (training, baseline)}
    alone = names[training] ^ names[baseline]
    if alone or not names[training]:
        raise ValueError(
            f"{training!r} and {baseline!r} have been measured on different cells: {sorted(alone) or 'none'}; "
            "leave out what has no fellow"
        )
    gains = [rates[policy, training, task] - rates[policy, baseline, task] for policy, task in sorted(names[training])]
    return sum(gains) / len(gains)
