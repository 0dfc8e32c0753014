"""Rows of the tables of docs/results/policy_rl.md; what they are about stands in pages.yaml."""

from collections import Counter
from statistics import mean

from benchmarks.tables.table import Rows, Run, lines, percent, points, points_over_seeds, read, share
from wm_nodes.core.statistics import paired_difference, t_interval

STUDY, ARMS = "policy_rl_seed_study.jsonl", "policy_rl_against_exploiting.json"
LIKELIHOOD, CONTROL = "policy_rl_likelihood.json", "policy_rl_scenes.json"


def push_cube() -> Rows:
    found = read(LIKELIHOOD)["study"]
    for one in found:
        rates = [percent(rate(one[key])) for key in ("real_before", "real_after")]
        yield (
            one["task"], one["seed"], *rates, points(one["success_before"], one["success_after"]),
            percent(rate(one["imagined_after"])), one["acceptance"]["outcome"],
        )
    whole = t_interval([100 * rate(one["real_after"]) for one in found])
    first, last = ([one[f"success_{when}"] for one in found] for when in ("before", "after"))
    yield (
        "push_cube", "all", percent(mean(map(mean, first))), f"{whole.mean:.1f} [{whole.low:.1f}, {whole.high:.1f}]",
        points_over_seeds(first, last), percent(mean(rate(one["imagined_after"]) for one in found)), "",
    )


def scenes() -> Rows:
    found = read(LIKELIHOOD)["scenes"]
    for task, advantage in dict.fromkeys((one["task"], one["advantage"]) for one in found):
        seeds = [one for one in found if (one["task"], one["advantage"]) == (task, advantage)]
        gains = [one["real_after"]["successes"] - one["real_before"]["successes"] for one in seeds]
        outcomes = Counter(one["acceptance"]["outcome"] for one in seeds)
        real = (
            criterion["value"] for one in seeds for criterion in one["acceptance"]["criteria"]
            if criterion["name"].startswith("done precision, cloned")
        )
        yield (
            task, "GRPO" if advantage == "group" else "PPO", *map(before_after, seeds), f"{mean(gains):+.1f}",
            percent(mean(one["imagined_after"]["rate"] for one in seeds)), ", ".join(f"{one:.2f}" for one in real),
            ", ".join(f"{outcomes[outcome]} {outcome}" for outcome in sorted(outcomes)),
        )


def rate(counts: Run) -> float:
    return float(counts["successes"] / counts["episodes"])


def before_after(one: Run) -> str:
    difference = paired_difference(one["success_before"], one["success_after"])
    text = f"{one['real_before']['successes']} → {one['real_after']['successes']}"
    return f"**{text}**" if difference.low > 0 or difference.high < 0 else text


def scenes_control() -> Rows:
    rows = read(CONTROL)["rows"]
    for task in dict.fromkeys(one["task"] for one in rows):
        of = [one for one in rows if one["task"] == task]
        totals = (sum(one[f"real_{when}"]["successes"] for one in of) for when in ("before", "after"))
        yield task, ", ".join(str(one["seed"]) for one in of), *totals


def simulator_control() -> Rows:
    rows = lines(STUDY)
    for task, last in (("push_cube", 2), ("push_cube", 4), ("reach", 4)):
        arms = ("world_model", "simulator") if last == 2 else ("world_model",)
        found = {
            (arm, when): [one[f"success_{when}"] for one in sorted(rows, key=lambda one: int(one["seed"]))
                          if (one["task"], one["model"]) == (task, arm) and one["seed"] <= last]
            for arm in arms for when in ("before", "after")
        }
        rates = {key: percent(mean(map(mean, successes))) for key, successes in found.items()}
        model, control = found["world_model", "after"], found.get(("simulator", "after"))
        yield (
            task, f"0 to {last}", rates["world_model", "before"], rates["world_model", "after"],
            points_over_seeds(found["world_model", "before"], model), rates.get(("simulator", "before"), ""),
            rates.get(("simulator", "after"), ""), points_over_seeds(model, control) if control else "",
        )


def against_exploiting() -> Rows:
    found = read(ARMS)["rows"]
    for arm in found:
        (shipped,) = [other for other in found if (other["task"], other["settings"]) == (arm["task"], "")]
        real, usual = ([seed["success_after"] for seed in of["seeds"]] for of in (arm, shipped))
        imagined = [seed["imagined_after"] for seed in arm["seeds"]]
        dreamt = sum(counts["successes"] for counts in imagined) / sum(counts["episodes"] for counts in imagined)
        updates = [list(readings) for readings in zip(*(seed["exploit_meter"] for seed in arm["seeds"]), strict=True)]
        calls = round(sum(one["imagined_success"] * one["episodes"] for one in updates[-1])) if updates else 0
        taken = [verdict["accepted"] for seed in arm["seeds"] for verdict in seed["refreshes"]]
        yield (
            arm["task"], arm["arm"], percent(mean(map(mean, real))),
            points_over_seeds(usual, real) if arm["settings"] else "",
            percent(dreamt), f"{100 * (dreamt - mean(map(mean, real))):.1f}",
            share(round(precision(updates[-1]) * calls), calls) if updates else "",
            ", ".join(percent(precision(readings)) for readings in updates),
            f"{sum(taken)} of {len(taken)}" if taken else "",
        )


def precision(readings: list[Run]) -> float:
    """Of the exploit meter, over the episodes of all readings."""
    calls = [reading["imagined_success"] * reading["episodes"] for reading in readings]
    return float(sum(n * reading["precision"] for n, reading in zip(calls, readings, strict=True)) / sum(calls))
