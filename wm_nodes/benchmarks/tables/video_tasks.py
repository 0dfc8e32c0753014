"""Rows of the tables of docs/results/video_tasks.md; what they are about stands in pages.yaml."""

from statistics import mean

from benchmarks.tables.table import Rows, Run, interval, lines, over_seeds, percent, points, read, runs
from benchmarks.tables.video_rl import gained, samplers
from benchmarks.video_rl.comparison import compare_samplers

OUTCOME, EARLY, REWARDS = (f"video_rl_outcome{of}.json" for of in ("", "_early", "_rewards"))
CLOSED_LOOP, LONGER, TRAINED_IN = (f"video_rl_closed_loop{of}" for of in (".jsonl", "_history.json", "_policies.json"))
BEFORE, AFTER_CPS, AFTER_RECORDINGS = (f"video model {of}" for of in ("before", "after CPS", "after recordings"))
PROBE_PAID = "CPS 0.4"
PAID_BY = {
    "CPS 0.4, execution": "action world model", "CPS 0.4, execution and outcome": "and 0.3 of the outcome",
    PROBE_PAID: "probe", "CPS 0.4, judge robot": "judge",
}
BEGIN, *_, LAST = MEASURED = ("0", "10", "20", "30")
REAL = "executed_success"
CHANGES = (("error_cm", 2), ("object_cm", 2), ("tool_cm", 2), ("psnr_db", 2))
UNPAID = (
    ("executed_success", 3), ("executed_object_cm", 1), ("reader_success", 3), ("object_permanence", 3),
    ("impossible_tool_steps", 3),
)


def outcome() -> Rows:
    for file, base in ((OUTCOME, ""), (EARLY, "early")):
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
    for name, trained in samplers(read(OUTCOME)["rows"]).items():
        cells = []
        for metric, digits in UNPAID:
            before, after = ([at(one, buffers, metric) for one in trained] for buffers in (BEGIN, "15"))
            changed = over_seeds([later - first for first, later in zip(before, after, strict=True)], digits)
            cells.append(f"{mean(before):.{digits}f} {changed}")
        yield name, len(trained), *cells


def executed() -> Rows:
    rewards = samplers(read(REWARDS)["rows"])
    probe = {one["seed"]: at(one, LAST, REAL) for one in rewards[PROBE_PAID]}
    for name, paid_by in PAID_BY.items():
        trained = sorted(rewards[name], key=lambda one: int(one["seed"]))
        ends = {one["seed"]: at(one, LAST, REAL) for one in trained}
        yield (
            paid_by, len(trained), *(f"{mean(at(one, buffers, REAL) for one in trained):.3f}" for buffers in MEASURED),
            ", ".join(f"{real:.2f}" for real in ends.values()),
            over_seeds([at(one, LAST, REAL) - at(one, BEGIN, REAL) for one in trained], 3),
            "" if name == PROBE_PAID else over_seeds([real - probe[seed] for seed, real in ends.items()], 3),
        )


def paid_and_real() -> Rows:
    rewards = samplers(read(REWARDS)["rows"])
    for name, paid_by in PAID_BY.items():
        trained = rewards[name]
        apart = (
            " → ".join(f"{mean(at(one, buffers, imagined) - at(one, buffers, REAL) for one in trained):+.2f}"
                       for buffers in MEASURED)
            for imagined in ("success", "execution_success", "accepted")
        )
        shares = ([mean(at(one, LAST, name) for one in trained) for name in (said, f"{said}_executed")]
                  for said in ("execution_success", "accepted"))
        true = (f"{executed / said:.2f}" for said, executed in shares)
        others = (
            " → ".join(f"{mean(at(one, buffers, metric) for one in trained):.2f}" for buffers in (BEGIN, LAST))
            for metric in ("reader_success", "object_permanence", "impossible_tool_steps")
        )
        yield paid_by, *apart, *true, *others


def at(row: Run, buffers: str, metric: str) -> float:
    """A held-out metric after so many buffers."""
    return float(row["measured"][buffers][metric])


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
