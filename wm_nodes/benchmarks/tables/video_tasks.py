"""Rows of the tables of docs/results/video_tasks.md; what they are about stands in pages.yaml."""

import math
from statistics import mean, variance

from benchmarks.tables.table import Rows, Run, interval, lines, percent, points, read, runs
from benchmarks.tables.video_rl import gained, over_seeds, samplers
from benchmarks.video_rl.comparison import compare_samplers
from wm_nodes.core.statistics import t_975

OUTCOME, EARLY, JUDGED = (f"video_rl_outcome{of}.json" for of in ("", "_early", "_judge"))
EXECUTED, MIXED = "video_rl_outcome_execution.json", "video_rl_outcome_mixed.json"
CLOSED_LOOP, LONGER, TRAINED_IN = (f"video_rl_closed_loop{of}" for of in (".jsonl", "_history.json", "_policies.json"))
BEFORE, AFTER_CPS, AFTER_RECORDINGS = (f"video model {of}" for of in ("before", "after CPS", "after recordings"))
PROBE_PAID, JUDGE_PAID = "CPS 0.4", "CPS 0.4, judge robot"
CHANGES = (("error_cm", 2), ("object_cm", 2), ("tool_cm", 2), ("psnr_db", 2))
UNPAID = (
    ("executed_success", 3), ("executed_object_cm", 1), ("reader_success", 3), ("object_permanence", 3),
    ("impossible_tool_steps", 3),
)
ACCEPTED = ("accepted", "accepted_executed")


def outcome() -> Rows:
    for file, base in ((OUTCOME, ""), (EARLY, "early"), (JUDGED, "")):
        rows = read(file)["rows"]
        for name, trained in samplers(rows).items():
            ends = (percent(mean(one["evaluations"][place]["success"] for one in trained)) for place in (0, -1))
            against = compare_samplers(rows, name, PROBE_PAID, ["success_path"]) if name != PROBE_PAID else None
            path = against.differences["success_path"] if against else None
            yield (
                name, base, len(trained), " → ".join(ends), *gained(trained, [("success", 3)]),
                interval(path.mean, path.low, path.high, 3) if path else "",
            )


def unpaid() -> Rows:
    rows = [one for one in read(OUTCOME)["rows"] + read(JUDGED)["rows"] if "measured" in one]
    for name, trained in samplers(rows).items():
        cells = []
        for metric, digits in UNPAID:
            before, after = ([one["measured"][when][metric] for one in trained] for when in ("0", "15"))
            changed = over_seeds([later - first for first, later in zip(before, after, strict=True)], digits)
            cells.append(f"{mean(before):.{digits}f} {changed}")
        yield name, len(trained), *cells


def executed() -> Rows:
    rows = sorted(read(OUTCOME)["rows"] + read(JUDGED)["rows"], key=lambda one: int(one["seed"]))
    judged = samplers(rows)[JUDGE_PAID]
    judge, probe = ([one["measured"]["15"]["executed_success"] for one in samplers(rows)[name]]
                    for name in (JUDGE_PAID, PROBE_PAID))
    change, (a, b) = mean(judge) - mean(probe), (variance(some) / len(some) for some in (judge, probe))
    freedom = (a + b) ** 2 / (a**2 / (len(judge) - 1) + b**2 / (len(probe) - 1))
    half, cells = t_975(int(freedom)) * math.sqrt(a + b), []
    for when in ("0", "15"):
        accepted, real = (mean(one["measured"][when][key] for one in judged) for key in ACCEPTED)
        cells += [percent(accepted), percent(real / accepted)]
    first = probe[: len(judge)]
    for paid_by, values, apart in (
        ("judge", judge, interval(change, change - half, change + half, 3)), ("probe", probe, ""),
        ("probe, first six", first, f"{mean(judge) - mean(first):+.3f}"),
    ):
        by_seed = ", ".join(f"{value:.2f}" for value in values)
        yield paid_by, by_seed, f"{mean(values):.3f}", apart, *(cells if paid_by == "judge" else [""] * 4)


def execution_paid() -> Rows:
    paid, mixed = (read(file)["rows"] for file in (EXECUTED, MIXED))
    probe = {one["seed"]: one["measured"]["15"] for one in read(OUTCOME)["rows"] if one["sampler"] == PROBE_PAID}
    for name, trained, when in (
        ("action world model, 15 buffers", paid, "15"), ("action world model, 20 buffers", paid, "20"),
        ("and 0.3 of the outcome, 20 buffers", mixed, "20"), ("probe, 15 buffers", paid, ""),
    ):
        probes = [probe[one["seed"]] for one in trained]
        after = [one["measured"][when] for one in trained] if when else probes
        real = [one["executed_success"] for one in after]
        gains = [now - one["measured"]["0"]["executed_success"] for now, one in zip(real, trained, strict=True)]
        apart = [now - one["executed_success"] for now, one in zip(real, probes, strict=True)]
        kinds = [mean(one.get(kind, math.nan) for one in after) for kind in ("success", "execution_success")]
        yield (
            name, ", ".join(f"{value:.2f}" for value in real), f"{mean(real):.3f}", over_seeds(gains, 3),
            over_seeds(apart, 3) if when else "", *(f"{kind:.3f}" if math.isfinite(kind) else "" for kind in kinds),
            f"{mean(one['executed_object_cm'] for one in after):.1f}",
        )


def closed_loop() -> Rows:
    trainings = closed_loop_trainings()
    for name, trained in trainings.items():
        better = mean(one["evaluations"][-1]["win"] for one in trained)
        yield name, len(trained), f"{trained[0]['learning_rate']:g}", *gained(trained, CHANGES), f"{100 * better:.0f}"
    rows = [one for trained in trainings.values() for one in trained]
    for name, base in (
        ("CPS 0.4", "recordings"), ("DynDiff 0.54 gated, rms", "CPS 0.4"), ("best of n and recordings", "CPS 0.4"),
    ):
        if pair := compare_samplers(rows, name, base, ["error_cm"]):
            found = pair.differences["error_cm"]
            apart = interval(found.mean, found.low, found.high, 2)
            yield f"{name} - {base}", len(pair.seeds), "", apart, "", "", "", ""


def closed_loop_trainings() -> dict[str, list[Run]]:
    return samplers([one for run in lines(CLOSED_LOOP) for one in run["rows"]])


def by_clip() -> Rows:
    trained = closed_loop_trainings()["CPS 0.4"]
    for clip in range(1, 5):
        yield clip, *gained(trained, [(f"{name}_cm_{clip}", 2) for name in ("object", "tool")])


def longer_histories() -> Rows:
    rows = read(LONGER)["rows"]
    for history in sorted({one["plan"]["history"] for one in rows}):
        of = [one for one in rows if one["plan"]["history"] == history]
        changes = [(f"{name}_cm_{clip}", 2) for clip in (3, 4) for name in ("object", "tool")]
        yield history, len(of), *gained(of, changes)


def trained_in() -> Rows:
    rows = read(TRAINED_IN)["rows"]
    for model in dict.fromkeys(one["model"] for one in rows):
        of = [one for one in rows if one["model"] == model]
        real, imagined = (mean(one[name]["rate"] for one in of) for name in ("real_after", "imagined_after"))
        accepted = sum(one["accepted"] for one in of)
        yield (
            model, ", ".join(percent(one["real_after"]["rate"]) for one in of), percent(real), percent(imagined),
            f"{100 * (imagined - real):+.1f}", f"{accepted} of {len(of)}",
        )


def ranking() -> Rows:
    found = runs("environments.jsonl")
    rows, correlations = found["trained in"]["rows"], found["ranking"]["correlations"]
    for model in dict.fromkeys(one["model"] for one in rows):
        real = [one["real_after"]["rate"] for one in rows if one["model"] == model]
        yield (
            model, ", ".join(map(percent, real)), percent(mean(real)),
            "{correlation:+.2f} [{low:+.2f}, {high:+.2f}]".format(**correlations[model]),
        )


def models_compared() -> Rows:
    rows = read(TRAINED_IN)["rows"]
    after = {(one["model"], one["seed"]): one["success_after"] for one in rows}
    for better, base in (
        (AFTER_CPS, BEFORE), (AFTER_CPS, AFTER_RECORDINGS), (AFTER_RECORDINGS, BEFORE),
        (f"{BEFORE}, threshold 0.9", BEFORE), ("world model", AFTER_CPS),
    ):
        seeds = [seed for model, seed in after if model == better and (base, seed) in after]
        won, base_won = ([x for seed in seeds for x in after[model, seed]] for model in (better, base))
        rates = [100 * (mean(after[better, seed]) - mean(after[base, seed])) for seed in seeds]
        yield f"{better} - {base}", len(won), points(base_won, won), over_seeds(rates, 1)
