"""Rows of the tables of docs/results/video_rl.md; what they are about stands in pages.yaml."""

from collections.abc import Sequence
from itertools import groupby
from statistics import mean, median

from benchmarks.tables.table import Rows, Run, interval, lines, over_seeds, percent, read
from benchmarks.video_rl.comparison import gains
from wm_nodes.core.statistics import bootstrap_mean, t_interval

LEARNING, ABLATIONS, CLIP_LEARNING = (f"video_rl_{name}.json" for name in ("learning", "ablations", "clip_learning"))
AS_WRITTEN = "video_rl_as_written.json"
FIRST, LAST = slice(0, 3), slice(-3, None)
"""Buffers of a training."""
SCORES = (("reward", 3), ("obeyed", 3), ("mass", 2), ("background", 4))
CLIP_SCORES = (("tracking", 3), ("object_cm", 2), ("tool_cm", 2), ("psnr_db", 3))


def sampler_of(run: Run) -> str:
    """Which sampler a row is about; files of before 2026-11-24 call it arm."""
    return str(run["sampler"] if "sampler" in run else run["arm"])


def samplers(rows: Sequence[Run]) -> dict[str, list[Run]]:
    """The trainings of each sampler."""
    return {name: [row for row in rows if sampler_of(row) == name] for name in dict.fromkeys(map(sampler_of, rows))}


def pair(comparison: Run) -> str:
    return f"{sampler_of(comparison)} - {comparison['base']}"


def diversity() -> Rows:
    for of in zip(*(run["comparisons"] for run in lines("video_rl_diversity.jsonl")), strict=True):
        yield (
            pair(of[0]), "shared" if of[0]["shared_noise"] else "own", "{:.2f}, {:.2f}".format(*of[0]["noise_share"]),
            *(interval(one["difference"], one["low"], one["high"], 3) for one in of),
            ", ".join(f"{100 * one['background_change']:+.0f}" for one in of),
        )


def clip_diversity() -> Rows:
    for of in zip(*(run["comparisons"] for run in lines("video_rl_clips.jsonl")), strict=True):
        cells = (interval(centre, low, high, 3) for centre, low, high in (one["diversity"] for one in of))
        yield pair(of[0]), "shared" if of[0]["shared_noise"] else "own", *cells


def learning() -> Rows:
    for name, trained in samplers(read(LEARNING)["rows"]).items():
        yield name, len(trained), *gained(trained, SCORES)


def gained(trained: Sequence[Run], measures: Sequence[tuple[str, int]]) -> list[str]:
    """Change of each measure over a training, with its interval over the seeds; of one seed the change alone."""
    return [over_seeds([course[-1] for course in gains(trained, name)], digits) for name, digits in measures]


def compared(comparison: Run, measures: Sequence[tuple[str, int]]) -> list[str]:
    found = ((comparison["differences"][name], digits) for name, digits in measures)
    return [interval(one["mean"], one["low"], one["high"], digits) for one, digits in found]


def learning_compared() -> Rows:
    measures = [one for one in SCORES if one[0] != "mass"]
    for one in read(LEARNING)["comparisons"]:
        yield pair(one), len(one["seeds"]), *compared(one, measures)


def long_learning() -> Rows:
    for name, trained in samplers(read("video_rl_learning_long.json")["rows"]).items():
        yield name, len(trained), f"{mean(one['evaluations'][-1]['obeyed'] for one in trained):.3f}"


def clip_learning() -> Rows:
    found = read(CLIP_LEARNING)
    for name, trained in samplers(found["rows"]).items():
        changes = ([mean(one["after"][key]) - mean(one["before"][key]) for one in trained] for key, _ in CLIP_SCORES)
        yield name, len(trained), *(over_seeds(one, digits) for one, (_, digits) in zip(changes, CLIP_SCORES))
    for one in found["comparisons"]:
        yield pair(one), len(one["seeds"]), *compared(one, CLIP_SCORES)


def cost() -> Rows:
    three = lines("video_rl_cost.jsonl")
    for same in zip(*(run["rows"] for run in three), strict=True):
        model = same[0]["model"]
        shares = (one["kl_s"] / (one["forward_s"] + one["kl_s"] + one["backward_s"]) for one in same)
        rollouts = [one for run in three for one in run["rollouts"] if one["model"] == model]
        masked = median(one["mask_share"] + one["cache_share"] for one in rollouts)
        mebibytes = f"{same[-1]['bytes'] / 2**20:.2f}"
        yield model, same[0]["anchor"], percent(median(shares)), mebibytes, f"{100 * masked:.2f}"


def public_sizes() -> Rows:
    keys = ("rollout_gib", "rollout_s_per_step_clip", "train_gib", "train_s_per_transition", "computed_iteration_h")
    for one in read("public_size.json")["rows"]:
        anchor_h = one["computed_train_h"] * one["rollout_s_per_step_clip"] / one["train_s_per_transition"]
        hours = one["computed_iteration_h"] + anchor_h
        numbers = (f"{value:.3g}" for value in (*(one[key] for key in keys), hours))
        yield one["model"], one["frames"], f"{one['parameters'] / 1e9:.2f}", one["tokens"], *numbers


def ablations() -> Rows:
    for one in read(ABLATIONS)["comparisons"]:
        yield pair(one), *compared(one, [("reward", 3), ("obeyed", 2), ("background", 4)])


def resolution() -> Rows:
    rows = sorted(read("video_rl_resolution.json")["rows"], key=lambda one: str(one["shown"]))
    for shown, sizes in groupby(rows, lambda one: str(one["shown"])):
        means = (bootstrap_mean(one["tracking"], seed=0) for one in sizes)
        yield shown, *("{:.3f} [{:.3f}, {:.3f}]".format(*one) for one in means)


def hacking() -> Rows:
    for name, trained in samplers(read("video_rl_hacking.json")["rows"]).items():
        worse = ({"obeyed", "mass"}, {"background"})
        alarms = [sum(bool(truths & set(one["hacked"])) for one in trained) for truths in worse]
        ends = [one["evaluations"][-1] for one in trained]
        after = (", ".join(f"{end[key]:.2f}" for end in ends) for key in ("consistency", "obeyed", "mass"))
        yield name, *after, *(f"{count} of {len(trained)}" for count in alarms)


def as_written() -> Rows:
    found = read(AS_WRITTEN)
    rates = {one["name"]: one["grpo"]["learning_rate"] for one in found["samplers"]}
    trainings = samplers(found["rows"])
    for name, trained in trainings.items():
        courses = (
            " → ".join(f"{mean(of_buffers(one, measure, part) for one in trained):.3f}" for part in (FIRST, LAST))
            for measure in ("reward_mean", "rollout_diversity")
        )
        yield (
            name, len(trained), f"{rates[name]:g}", *courses,
            ", ".join(f"{one['evaluations'][-1]['success']:.2f}" for one in trained),
            *gained(trained, [("success", 3), ("outcome", 3)]),
        )
    first, *others = trainings
    of_seed = {one["seed"]: one for one in trainings[first]}
    for other in others:
        pairs = [(of_seed[one["seed"]], one) for one in trainings[other]]
        apart = [
            t_interval([of_buffers(one, measure, LAST) - of_buffers(base, measure, LAST) for one, base in pairs])
            for measure in ("reward_mean", "rollout_diversity")
        ] + [
            t_interval([one["evaluations"][-1][name] - base["evaluations"][-1][name] for one, base in pairs])
            for name in ("success", "outcome")
        ]
        cells = [interval(one.mean, one.low, one.high, 3) for one in apart]
        yield f"{first} - {other}", len(pairs), "", *cells[:2], "", *cells[2:]


def of_buffers(row: Run, measure: str, part: slice) -> float:
    values: list[float] = row["buffers"][measure]
    return mean(values[part])
