"""The picture of docs/results/policy_rl.md, drawn from the same files as its tables."""

from pathlib import Path
from statistics import mean

from benchmarks.tables import policy_rl
from benchmarks.tables.table import lines, read
from wm_nodes.reports.figures import COLOURS, add_legend, make_figure, save_figure, style_axes


def draw_tasks(path: Path) -> None:
    """Success of each task before and after training in the world model, beside imagined success and the control."""
    found = read(policy_rl.LIKELIHOOD)
    trained = [one for one in (*found["study"], *found["scenes"]) if one.get("advantage", "gae") == "gae"]
    control = [one for one in lines(policy_rl.STUDY) if one["model"] == "simulator"] + read(policy_rl.CONTROL)["rows"]
    tasks = list(dict.fromkeys(one["task"] for one in trained))
    figure = make_figure(7, 3)
    axes = figure.subplots()
    style_axes(axes, "", "success, %, mean over seeds")
    for colour, (name, rows, key, mark) in zip(COLOURS, (
        ("cloned", trained, "real_before", "o"), ("after PPO in the world model", trained, "real_after", "o"),
        ("imagined by then", trained, "imagined_after", "x"), ("control: PPO in simulator", control, "real_after", "s"),
    ), strict=True):
        rates = [[policy_rl.rate(one[key]) for one in rows if one["task"] == task] for task in tasks]
        axes.plot([100 * mean(of) for of in rates], range(len(tasks)), mark, color=colour, label=name)
    axes.set_yticks(range(len(tasks)), tasks)
    axes.set(xlim=(0, 102), ylim=(len(tasks) - 0.5, -0.5))
    add_legend(axes)
    save_figure(figure, path)
