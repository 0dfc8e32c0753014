"""The tables of the result pages say what the result files and the shipped manifests hold."""

import json
import re
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import mean, median, variance
from typing import Any

import pytest

import wm_nodes
from benchmarks.video_rl.comparison import Difference, compare_samplers, gains, paired_interval
from wm_nodes.core.statistics import bootstrap_mean, paired_difference, wilson_interval

ROOT = Path(wm_nodes.__file__).parents[1]
DOCS, FILES = ROOT / "docs", ROOT / "benchmarks" / "results"
GUIDES = ("README", "audit", "embedded_judge", "model_refresh", "public_video_models")
SHIPPED = Path(wm_nodes.__file__).parent / "pretrained"
LINK = re.compile(r"\]\(([^)\s]+)\)")
ABLATIONS = ("KL of log-probabilities", "no KL", "clip 5 against 2.5", "guidance", "pictures of 20 cells")
"""The comparisons of the file, in its order, as the page calls them."""
Run = dict[str, Any]
Rows = Iterator[str]


def read(name: str) -> Run:
    content: Run = json.loads((FILES / name).read_text())
    return content


def runs(name: str) -> dict[str, Run]:
    """The runs of a .jsonl file by name."""
    return {run["run"]: run for run in map(json.loads, (FILES / name).read_text().splitlines())}


def row(*cells: object) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def percent(value: float) -> str:
    return f"{100 * value:.1f}"


def interval(value: float, low: float, high: float, digits: int) -> str:
    """A difference with its 95 % interval, bold where 0 lies outside."""
    text = f"{value:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]"
    return f"**{text}**" if low > 0 or high < 0 else text


def share(found: Run, name: str = "accuracy") -> str:
    return f"{percent(found[name])} [{percent(found['low'])}, {percent(found['high'])}]"


# --- policy_rl.md -----------------------------------------------------------------------------------------------
def study_rows() -> Rows:
    lines = list(map(json.loads, (FILES / "policy_rl_seed_study.jsonl").read_text().splitlines()))
    study = {(line["task"], line["arm"], line["seed"]): line for line in lines}
    for task in ("push_cube", "reach"):
        models = [study[task, "world_model", seed] for seed in range(5)]
        controls = [study.get((task, "simulator", seed)) for seed in range(5)]
        before, after = ([x for model in models for x in model[key]] for key in ("success_before", "success_after"))
        if task == "reach":
            yield f"from {percent(mean(before))} to {percent(mean(after))} %, {points(before, after)}"
        pairs = [(model, control) for model, control in zip(models, controls) if control]
        in_model = [x for model, _ in pairs for x in model["success_after"]]
        in_simulator = [x for _, control in pairs for x in control["success_after"]]
        if pairs:
            yield row(task, percent(mean(in_model)), percent(mean(in_simulator)), points(in_model, in_simulator))


def likelihood_rows() -> Rows:
    """PushCube, a line per seed; then the scenes' tasks, one for each algorithm, bold where a seed's paired interval
    excludes 0."""
    found = read("policy_rl_likelihood.json")
    for one in found["study"]:
        rates = [percent(one[key]["successes"] / one[key]["episodes"]) for key in ("real_before", "real_after")]
        yield row(
            one["task"], one["seed"], *rates, points(one["success_before"], one["success_after"]),
            percent(one["imagined_after"]["successes"] / one["imagined_after"]["episodes"]),
            one["acceptance"]["outcome"],
        )
    for task, advantage in dict.fromkeys((one["task"], one["advantage"]) for one in found["scenes"]):
        seeds = [one for one in found["scenes"] if (one["task"], one["advantage"]) == (task, advantage)]
        assert [one["seed"] for one in seeds] == [0, 1, 2]
        gains = [one["real_after"]["successes"] - one["real_before"]["successes"] for one in seeds]
        outcomes = Counter(one["acceptance"]["outcome"] for one in seeds)
        yield row(
            task, "GRPO" if advantage == "group" else "PPO",
            *map(before_after, seeds), f"{mean(gains):+.1f}",
            percent(mean(one["imagined_after"]["rate"] for one in seeds)),
            ", ".join(f"{outcomes[outcome]} {outcome}" for outcome in sorted(outcomes)),
        )


def before_after(one: Run) -> str:
    difference = paired_difference(one["success_before"], one["success_after"])
    text = f"{one['real_before']['successes']} → {one['real_after']['successes']}"
    return f"**{text}**" if difference.low > 0 or difference.high < 0 else text


def points(before: list[bool], after: list[bool]) -> str:
    found = paired_difference(before, after)
    return interval(100 * found.difference, 100 * found.low, 100 * found.high, 1)


def exploiting_rows() -> Rows:
    """One line per task and means against exploiting, over the seeds; differences are from the model as shipped."""
    found = read("policy_rl_against_exploiting.json")["rows"]
    for one in found:
        (shipped,) = [other for other in found if (other["task"], other["settings"]) == (one["task"], "")]
        real, usual = ([x for seed in arm["seeds"] for x in seed["success_after"]] for arm in (one, shipped))
        imagined = [seed["imagined_after"] for seed in one["seeds"]]
        last = [seed["exploit_meter"][-1] for seed in one["seeds"] if seed["exploit_meter"]]
        calls = round(sum(reading["imagined_success"] * reading["episodes"] for reading in last))
        yield row(
            one["task"], one["arm"], percent(mean(real)), points(usual, real) if one["settings"] else "",
            percent(sum(rate["successes"] for rate in imagined) / sum(rate["episodes"] for rate in imagined)),
            share_of(round(precision(last) * calls), calls) if last else "",
        )
        if one["arm"] == "as shipped" and last:
            by_update = zip(*(seed["exploit_meter"] for seed in one["seeds"]), strict=True)
            yield ", ".join(percent(precision(list(readings))) for readings in by_update)
        if verdicts := [verdict["accepted"] for seed in one["seeds"] for verdict in seed["refreshes"]]:
            yield f"{sum(verdicts)} of {len(verdicts)} on {one['task']}"


def precision(readings: list[Run]) -> float:
    """Of the exploit meter, over the episodes of all readings."""
    calls = [reading["imagined_success"] * reading["episodes"] for reading in readings]
    return sum(n * reading["precision"] for n, reading in zip(calls, readings, strict=True)) / sum(calls)


def control_rows_of_scenes() -> Rows:
    """PPO in the simulator, over the seeds of a task."""
    rows = read("policy_rl_scenes.json")["rows"]
    for task in dict.fromkeys(one["task"] for one in rows):
        before, after = (
            sum(one[f"real_{when}"]["successes"] for one in rows if one["task"] == task) for when in ("before", "after")
        )
        yield f"{task} {before} → {after}"


# --- video_rl.md ------------------------------------------------------------------------------------------------
def diversity_rows() -> Rows:
    seeds = runs("video_rl_diversity.jsonl").values()
    for arm, base, shared in (
        ("DynDiff 0.2 sparse, rms", "CPS 0.2", True),
        ("DynDiff 0.4 gated, rms", "CPS 0.4", True),
        ("DynDiff 0.2 sparse, rms", "CPS 0.2", False),
        ("DynDiff 0.6 gated", "CPS 0.6", False),
        ("DynDiff 0.6 gated", "CPS 0.6", True),
    ):
        found = [compared(run["comparisons"], arm, base, shared_noise=shared) for run in seeds]
        noise = ", ".join(f"{value:.2f}" for value in found[0]["noise_share"])
        yield row(
            f"{arm} - {base}", "shared" if shared else "own", noise,
            *(interval(one["difference"], one["low"], one["high"], 3) for one in found),
        )


def compared(comparisons: list[Run], sampler: str, base: str, **more: object) -> Run:
    wanted = {"base": base, **more}
    of = [one for one in comparisons if sampler_of(one) == sampler]
    (found,) = [one for one in of if all(one[key] == value for key, value in wanted.items())]
    return found


def sampler_of(row: Run) -> str:
    """Which sampler a row is about; files of before 2026-11-24 call it arm."""
    return str(row["sampler"] if "sampler" in row else row["arm"])


def clip_rows() -> Rows:
    seeds = runs("video_rl_clips.jsonl").values()
    for arm, base in (("DynDiff 0.2 sparse, rms", "CPS 0.2"), ("DynDiff 0.4 gated, rms", "CPS 0.4")):
        for shared in (True, False):
            found = [compared(run["comparisons"], arm, base, shared_noise=shared) for run in seeds]
            first, *others = (one["diversity"] for one in found)
            assert all(high < 0 for _, _, high in others)
            yield row(
                f"{arm} - {base}", "shared" if shared else "own", interval(*first, digits=3),
                ", ".join(f"{value:+.3f}" for value, _, _ in others),
            )


def learning_rows() -> Rows:
    found = read("video_rl_learning.json")
    measures = (("reward", 3), ("obeyed", 3), ("mass", 2), ("background", 4))
    for name in (
        "CPS 0.46, shared", "CPS 0.6, shared", "DynDiff 0.6 gated, rms, cps, shared", "CPS 0.6, window",
        "DynDiff 0.6 gated, rms, cps, window", "signed FM, ODE",
    ):
        trained = [one for one in found["rows"] if sampler_of(one) == name]
        gained = (paired_interval([course[-1] for course in gains(trained, key)]) for key, _ in measures)
        yield row(
            short(name), len(trained),
            *(interval(one.mean, one.low, one.high, digits) for one, (_, digits) in zip(gained, measures)),
        )
    for name, base in (
        ("DynDiff 0.6 gated, rms, cps, shared", "CPS 0.46, shared"),
        ("DynDiff 0.6 gated, rms, cps, shared", "CPS 0.6, shared"),
        ("DynDiff 0.6 gated, rms, cps, window", "CPS 0.6, window"),
    ):
        one = compared(found["comparisons"], name, base)
        yield row(f"{short(name)} - {base}", *(difference(one, *measure) for measure in measures[:2]))


def long_learning_rows() -> Rows:
    found = read("video_rl_learning_long.json")["rows"]
    ends = []
    for name in dict.fromkeys(sampler_of(one) for one in found):
        last = [one["evaluations"][-1] for one in found if sampler_of(one) == name]
        assert {one["iteration"] for one in last} == {160}
        ends.append(f"{short(name)} {mean(one['obeyed'] for one in last):.3f}")
    yield "; ".join(ends)


def short(sampler: str) -> str:
    return sampler.replace("DynDiff 0.6 gated, rms, cps", "DynDiff")


def difference(comparison: Run, name: str, digits: int) -> str:
    found = comparison["differences"][name]
    return interval(found["mean"], found["low"], found["high"], digits)


# --- video_tasks.md ---------------------------------------------------------------------------------------------
def outcome_rows() -> Rows:
    """One line per arm: success at both ends, gain, and the mean over the training against CPS on the same seeds."""
    truth, early, judged = (read(f"video_rl_outcome{of}.json")["rows"] for of in ("", "_early", "_judge"))
    arms = [(name, rows) for names, rows in (
        (OUTCOME_ARMS, truth), (OUTCOME_ARMS[:2], early), (JUDGE_ARMS, judged),
    ) for name in names]
    for name, of in arms:
        trained = [one for one in of if one["sampler"] == name]
        ends = (percent(mean(one["evaluations"][place]["success"] for one in trained)) for place in (0, -1))
        gained = paired_interval([course[-1] for course in gains(trained, "success")])
        against = None if of is judged else compare_samplers(of, name, "CPS 0.4", ["success_path"])
        yield row(
            f"{name}, early base" if of is early else name, len(trained), " → ".join(ends),
            interval(gained.mean, gained.low, gained.high, 3),
            "" if against is None else interval_of(against.differences["success_path"], 3),
        )


OUTCOME_ARMS = (
    "CPS 0.4", "DynDiff 0.54 gated, rms", "CPS 0.4, window", "DynDiff 0.54 gated, rms, window", "DynDiff 0.6 gated",
    "signed FM, ODE",
)
JUDGE_ARMS = ("CPS 0.4, judge robot",)
HELDOUT_METRICS = (
    ("executed_success", 3), ("executed_object_cm", 1), ("reader_success", 3), ("object_permanence", 3),
    ("impossible_tool_steps", 3),
)


def interval_of(found: Difference, digits: int) -> str:
    return interval(found.mean, found.low, found.high, digits)


def heldout_metric_rows() -> Rows:
    """One line per arm: mean before, and change, of metrics that nothing was trained on."""
    rows = read("video_rl_outcome.json")["rows"] + read("video_rl_outcome_judge.json")["rows"]
    for name in ("CPS 0.4", "DynDiff 0.54 gated, rms", "signed FM, ODE", *JUDGE_ARMS):
        mine = [one for one in rows if one["sampler"] == name and "measured_after" in one]
        cells = [str(len(mine))]
        for metric, digits in HELDOUT_METRICS:
            before, after = ([one[f"measured_{when}"][metric] for one in mine] for when in ("before", "after"))
            changed = paired_interval([later - first for first, later in zip(before, after, strict=True)])
            cells.append(f"{mean(before):.{digits}f} {interval_of(changed, digits)}")
        yield row(name, *cells)


def executed_rows() -> Rows:
    """Executed success after, by seed, paid by the judge and by the probe; the difference of their means (Welch)."""
    rows = read("video_rl_outcome.json")["rows"] + read("video_rl_outcome_judge.json")["rows"]
    judge, probe = (
        [one["measured_after"]["executed_success"] for one in sorted(rows, key=lambda one: one["seed"])
         if one["sampler"] == name] for name in ("CPS 0.4, judge robot", "CPS 0.4")
    )
    yield f"judge {', '.join(f'{v:.2f}' for v in judge)}; probe {', '.join(f'{v:.2f}' for v in probe)}."
    change, (a, b) = mean(judge) - mean(probe), (variance(some) / len(some) for some in (judge, probe))
    freedom = (a + b) ** 2 / (a**2 / (len(judge) - 1) + b**2 / (len(probe) - 1))
    assert int(freedom) == 10
    half = 2.228 * (a + b) ** 0.5  # 97.5 % quantile of Student's t for 10 degrees of freedom
    first = mean(judge) - mean(probe[: len(judge)])
    yield f"{interval(change, change - half, change + half, 3)} (Welch); on the first six alone {first:+.3f}"
    shares = {
        (when, name): mean(one[f"measured_{when}"][name] for one in rows if one["sampler"] == "CPS 0.4, judge robot")
        for when in ("before", "after") for name in ("accepted", "accepted_executed")
    }
    real = [percent(shares[when, "accepted_executed"] / shares[when, "accepted"]) for when in ("before", "after")]
    accepted = [percent(shares[when, "accepted"]) for when in ("before", "after")]
    yield f"{accepted[0]} before, {accepted[1]} after; {' and '.join(real)} %"


def closed_loop_rows() -> Rows:
    """One line per arm: change of whole rollouts, and how many got better; an arm of one seed has no interval."""
    measures = (("error_cm", 2), ("object_cm", 2), ("tool_cm", 2), ("psnr_db", 2))
    for name, trained in closed_loop_trainings().items():
        changes = [(rise(trained, measure), digits) for measure, digits in measures]
        cells = (interval_of(paired_interval(one), digits) if len(one) > 1 else f"{one[0]:+.{digits}f}"
                 for one, digits in changes)
        better = mean(one["evaluations"][-1]["win"] for one in trained)
        yield row(name, len(trained), f"{trained[0]['learning_rate']:g}", *cells, f"{100 * better:.0f}")


def horizon_rows() -> Rows:
    """One line per clip of a rollout: change by CPS."""
    trained = closed_loop_trainings()["CPS 0.4"]
    for clip in range(1, 5):
        cells = [interval_of(paired_interval(rise(trained, f"{name}_cm_{clip}")), 2) for name in ("object", "tool")]
        yield row(clip, *cells)


def closed_loop_trainings() -> dict[str, list[Run]]:
    rows = [one for run in runs("video_rl_closed_loop.jsonl").values() for one in run["rows"]]
    return {name: [one for one in rows if one["sampler"] == name] for name in sorted({one["sampler"] for one in rows})}


def rise(trained: list[Run], name: str) -> list[float]:
    return [course[-1] for course in gains(trained, name)]


def trained_in_rows() -> Rows:
    """One line per model: real success of its policies by seed, their mean, the imagined one beside it, and how the
    model ranks policies."""
    found = runs("environments.jsonl")
    rows, correlations = found["trained in"]["rows"], found["ranking"]["correlations"]
    for model in dict.fromkeys(one["model"] for one in rows):
        mine = [one for one in rows if one["model"] == model]
        by_seed = ", ".join(percent(one["real_after"]["rate"]) for one in mine)
        real, imagined = (mean(one[name]["rate"] for one in mine) for name in ("real_after", "imagined_after"))
        rank = "{correlation:+.2f} [{low:+.2f}, {high:+.2f}]".format(**correlations[model])
        yield row(model, by_seed, percent(real), percent(imagined), f"{100 * (imagined - real):+.1f}", rank)


def model_pair_rows() -> Rows:
    """One line per pair of models: the policies' real success after, paired by episode over all seeds."""
    rows = runs("environments.jsonl")["trained in"]["rows"]
    after = {(one["model"], one["seed"]): one["success_after"] for one in rows}
    seeds = sorted({one["seed"] for one in rows})
    for better, base in (
        ("video model after", "video model before"), ("world model", "video model after"),
    ):
        pair = paired_difference(*([won for seed in seeds for won in after[model, seed]] for model in (base, better)))
        changed = interval(100 * pair.difference, 100 * pair.low, 100 * pair.high, 1)
        by_seed = paired_interval([100 * (mean(after[better, seed]) - mean(after[base, seed])) for seed in seeds])
        yield row(f"{better} - {base}", pair.episodes, changed, interval_of(by_seed, 1))


def clip_learning_rows() -> Rows:
    found = read("video_rl_clip_learning.json")
    measures = (("tracking", 3), ("object_cm", 2), ("tool_cm", 2), ("psnr_db", 3))
    for arm in ("CPS 0.4", "DynDiff 0.6 gated, rms"):
        trained = [one for one in found["rows"] if one["arm"] == arm]
        yield row(arm, *(change(trained, name, digits) for name, digits in measures))
    one = compared(found["comparisons"], "DynDiff 0.6 gated, rms", "CPS 0.4")
    yield row("difference", *(difference(one, name, digits) for name, digits in measures))


def change(trained: list[Run], name: str, digits: int) -> str:
    found = paired_interval([mean(one["after"][name]) - mean(one["before"][name]) for one in trained])
    return interval(found.mean, found.low, found.high, digits)


def cost_rows() -> Rows:
    """One line per model: medians over the runs of the three anchors' share and memory, and of the mask's share."""
    three = list(runs("video_rl_cost.jsonl").values())
    for model in ("moving disc", "PushCube"):
        anchors = [same for same in zip(*(run["rows"] for run in three)) if same[0]["model"] == model]
        shares = (
            median(one["kl_s"] / (one["forward_s"] + one["kl_s"] + one["backward_s"]) for one in same)
            for same in anchors
        )
        kept = (f"{same[-1]['bytes'] / 2**20:.2f}" for same in anchors)
        rollouts = [one for run in three for one in run["rollouts"] if one["model"] == model]
        masked = median(one["mask_share"] + one["cache_share"] for one in rollouts)
        assert [same[0]["anchor"] for same in anchors] == ["buffer", "frozen", "dual"]
        yield row(model, ", ".join(map(percent, shares)), ", ".join(kept), f"{100 * masked:.2f}")


def ablation_rows() -> Rows:
    comparisons = read("video_rl_ablations.json")["comparisons"]
    for one, text in zip(comparisons, ABLATIONS, strict=True):
        found = one["differences"]["obeyed"]
        beside_0 = not found["low"] <= 0 <= found["high"]
        yield f"Guidance 2 - 1: obeyed {difference(one, 'obeyed', 2)}" if beside_0 else text


def resolution_rows() -> Rows:
    rows = read("video_rl_resolution.json")["rows"]
    for shown in ("model", "codec alone", "first frame repeated"):
        sizes = [one for one in rows if one["shown"] == shown]
        yield row(shown, *("{:.3f} [{:.3f}, {:.3f}]".format(*bootstrap_mean(one["tracking"], seed=0)) for one in sizes))
    (enlarged,) = {f"{mean(one['tracking']):.3f}" for one in rows if one["shown"] == "the model's own size, enlarged"}
    yield f"keep {enlarged} at every size"


def hacking_rows() -> Rows:
    rows = read("video_rl_hacking.json")["rows"]
    for arm in ("honest reward", "consistency alone", "consistency, frozen anchor"):
        trained = [one for one in rows if one["arm"] == arm]
        alarms = sum(bool({"obeyed", "mass"} & set(one["hacked"])) for one in trained)
        ends = [one["evaluations"][-1] for one in trained]
        after = (", ".join(f"{end[name]:.2f}" for end in ends) for name in ("consistency", "obeyed", "mass"))
        yield row(arm, *after, f"{alarms} of 3")


# --- judge.md ---------------------------------------------------------------------------------------------------
def hacked_rows() -> Rows:
    """By pattern, over its edits at the steps that anybody sees."""
    for name in ("judge_hack.json", "judge_hack_scenes.json"):
        for pattern in ("occlusion", "motion", "background", "physics", "benign"):
            steps = (1, 2, 3, 4) if pattern == "benign" else (3, 4)
            chosen = [one for one in read(name)["counts"] if one["pattern"] == pattern and one["step"] in steps]
            n = sum(one["n"] for one in chosen)
            paid, silent = (round(sum(one["n"] * one[key] for one in chosen)) for key in ("share", "silent"))
            low, high = wilson_interval(paid, n)
            yield row(pattern, n, f"{percent(paid / n)} [{percent(low)}, {percent(high)}]", percent(silent / n))


def checked_rows() -> Rows:
    for name, parts in read("judge_check.json")["paid"].items():
        yield row(name, "{count} of {of}".format(**parts["policy"]))


def erring_rows() -> Rows:
    for one in read("judge_erring.json")["ways"]:
        few = ("neither",) if one["honest"] else ("neither", "no planning", "no gates", "no reflection")
        if (one["rate"], one["shared"]) != (0.1, 0.0) or one["way"] in few:
            continue
        found = one["difference"] or one
        numbers = (found[key] for key in ("accuracy", "faults_accepted", "successes_kept"))
        signed = "{:+.1f}" if one["difference"] else "{:.1f}"
        cells = (f"{signed} ({signed} to {signed})".format(*(100 * value for value in number)) for number in numbers)
        errors = "honest" if one["honest"] else "overconfident"
        yield row(errors, one["way"], *cells, signed.format(found["calls"][0]))


# --- speed.md ---------------------------------------------------------------------------------------------------
def speed_summary_rows() -> Rows:
    for name, run in runs("speed.jsonl").items():
        low, high = run["graph"]["overhead_95"]
        ratios = (run["imagined_over_simulator"], run.get("imagined_over_stock_simulator"))
        yield row(
            name, f"{run['graph_overhead']:.2f} [{low:.2f}, {high:.2f}]", f"{run['step_growth']:.2f}",
            f"{run['imagined_steps_per_s']:.0f}", *("" if one is None else f"{one:.1f}" for one in ratios),
        )


def stage_rows() -> Rows:
    first, second = (runs("speed.jsonl")[name]["stages"] for name in ("full, 1", "full, 2"))
    for stage in first:
        yield row(stage, *(f"{stages[stage]['ms']:.1f}" for stages in (first, second)))


def device_rows() -> Rows:
    found = read("speed_device.json")
    ways = ("loop over host arrays", "eager", "captured")
    points: dict[tuple[Any, ...], Run] = {}
    for one in found["imagination"]:
        points.setdefault((f"{one['model']}, {one['px']} px", one["envs"]), {})[one["way"]] = one
    for (model, envs), by_way in points.items():
        if envs in (64, 1024) and model in ("shipped, 64 px", "gpu, 128 px"):
            rates = (f"{by_way[way]['median']:,.0f}" if way in by_way else "" for way in ways)
            yield row(model, envs, *rates, f"{max(one['peak_mib'] for one in by_way.values()) / 1024:.1f}")
    exact, bfloat16 = (percent(one["terminated_equal"]) for one in found["agreement"] if "terminated_equal" in one)
    yield f"float32: {exact} % of ends are the same; bfloat16: {bfloat16} %"
    tokenizer, action = (
        next(one for one in found["training"] if (one["trained"], one["model"], one["batch"]) == (name, "gpu", batch))
        for name, batch in (("tokenizer", 256), ("action model", 64))
    )
    yield f"tokenizer {tokenizer['median']:.0f} ms ({tokenizer['peak_mib'] / 1024:.1f} GiB)"
    yield f"action model {action['median']:.0f} ms ({action['peak_mib'] / 1024:.1f} GiB)"


# --- shipped_models.md ------------------------------------------------------------------------------------------
def heldout(folder: str, name: str = "heldout") -> Run:
    metrics: Run = json.loads((SHIPPED / folder / "manifest.json").read_text())[name]
    return metrics


def world_model_rows() -> Rows:
    found = heldout("table_top_cube")
    for text, name in (("object that moved, cm", "object_moved"), ("tool, cm", "tool")):
        yield row(text, *(f"{found[f'{name}_{kind}_cm_h16']:.2f}" for kind in ("rollout", "floor", "copy")))
    kinds = ("rollout", "recon", "copy")
    extreme = heldout("table_top_cube", "heldout_extreme")
    yield row("PSNR, dB", *(f"{found[f'psnr_{kind}_db_h16']:.1f}" for kind in kinds))
    yield row("PSNR under extreme actions, dB", *(f"{extreme[f'psnr_{kind}_db_h16']:.1f}" for kind in kinds))
    for text, name in (("SSIM", "ssim"), ("perceptual distance (RS-5a)", "perceptual")):
        yield row(text, *(f"{found[f'{name}_{kind}_h16']:.2f}" for kind in kinds))
    for step in (4, 16):
        yield f"{found[f'psnr_shuffled_drop_db_h{step:02d}']:.1f} dB at step {step}"
    goals = (beside_copy(found, f"goal_{name}{{}}_cm", "", "_copy") for name in ("object", "tool"))
    yield "object {} cm, tool {} cm".format(*goals)


def scenes_model_rows() -> Rows:
    """One line per task; reach_object's object hardly moves."""
    made = json.loads((SHIPPED / "table_top_objects" / "manifest.json").read_text())
    splits = [made[name] for name in ("heldout", "heldout_ood_object", "heldout_ood_combo")]
    for task in made["tasks"]:
        first, *_ = found = [split[task] for split in splits]
        moved, tool = (
            ["/".join(f"{one[f'{name}_rollout_cm_h16']:.1f}" for one in found),
             *(f"{first[f'{name}_{kind}_cm_h16']:.1f}" for kind in ("floor", "copy"))]
            for name in ("object_moved", "tool")
        )
        done = ("/".join(f"{one[f'done_{task}_{name}']:.2f}" for one in found) for name in ("precision", "recall"))
        moved = ["", "", ""] if task == "reach_object" else moved
        yield row(task, *moved, tool[0], tool[2], *done)
        extreme = made["heldout_extreme"][task]
        yield row(
            task, beside_copy(first, "psnr_{}_db_h16", "rollout"), f"{first['psnr_shuffled_drop_db_h16']:.1f}",
            beside_copy(extreme, "psnr_{}_db_h16", "rollout"),
            *(beside_copy(first, f"goal_{name}{{}}_cm", "", "_copy") for name in ("object", "tool")),
        )


def beside_copy(metrics: Run, pattern: str, ours: str, copy: str = "copy") -> str:
    return "{:.1f} ({:.1f})".format(*(metrics[pattern.format(name)] for name in (ours, copy)))


def done_rows() -> Rows:
    found = heldout("table_top_cube")
    for task in ("push_cube", "reach"):
        rates = {name: found[f"done_{task}_{name}"] for name in ("auc", "recall", "real_rate", "imagined_rate")}
        n = found["episodes"]
        hits = round(rates["recall"] * rates["real_rate"] * n)
        shares = (of_counts(hits, round(rates[name] * n)) for name in ("imagined_rate", "real_rate"))
        yield row(task, f"{rates['auc']:.3f}", *shares)


def of_counts(hits: int, n: int) -> str:
    return f"{hits} of {n}, {share_of(hits, n)}"


def share_of(hits: int, n: int) -> str:
    low, high = wilson_interval(hits, n)
    return f"{percent(hits / n)} [{percent(low)}, {percent(high)}]"


def video_model_rows() -> Rows:
    found = heldout("table_top_cube/video_model")
    measures = {"object, cm": ("object_cm", 2), "tool, cm": ("tool_cm", 2), "tracking score": ("tracking", 3)}
    for text, (name, digits) in {**measures, "PSNR, dB": ("psnr_db", 1)}.items():
        yield row(text, *(f"{found[key]:.{digits}f}" for key in (name, f"copy_{name}")))


TABLES: dict[str, list[Callable[[], Rows]]] = {
    "policy_rl": [
        likelihood_rows, study_rows, exploiting_rows, control_rows_of_scenes,
    ],
    "video_rl": [
        diversity_rows, clip_rows, learning_rows, long_learning_rows, clip_learning_rows, cost_rows, ablation_rows,
        resolution_rows, hacking_rows,
    ],
    "video_tasks": [
        outcome_rows, heldout_metric_rows, executed_rows, closed_loop_rows, horizon_rows, trained_in_rows,
        model_pair_rows,
    ],
    "judge": [
        hacked_rows, checked_rows, erring_rows,
    ],
    "speed": [speed_summary_rows, stage_rows],
    "../devices": [device_rows],
    "shipped_models": [world_model_rows, scenes_model_rows, done_rows, video_model_rows],
}


@pytest.mark.parametrize(("page", "rows"), [(page, rows) for page in TABLES for rows in TABLES[page]])
def test_every_row_of_a_table_is_what_its_file_holds(page: str, rows: Callable[[], Rows]) -> None:
    text = (DOCS / "results" / f"{page}.md").read_text()
    missing = [expected for expected in rows() if expected not in text]
    assert not missing


def test_every_result_file_is_linked_from_a_page_and_every_relative_link_of_a_document_leads_somewhere() -> None:
    pages = [*DOCS.glob("*.md"), *DOCS.glob("*/*.md")]
    targets = {
        (page, (page.parent / target.split("#")[0]).resolve())
        for page in pages
        for target in LINK.findall(page.read_text())
        if ":" not in target and not target.startswith("#")
    }
    assert not [(str(page), str(target)) for page, target in targets if not target.exists()]
    linked = {target for _, target in targets}
    assert not [path.name for path in FILES.iterdir() if path.suffix != ".md" and path.resolve() not in linked]


def words(*pages: Path) -> int:
    """Words and numbers of the pages; a table's bars and dashes are none."""
    return sum(len(re.findall(r"\S*\w\S*", page.read_text())) for page in pages)


def test_documents_are_short() -> None:
    results, guides = sorted((DOCS / "results").glob("*.md")), [DOCS / f"{name}.md" for name in GUIDES]
    assert not [page.name for page in results if words(page) > 1500]
    assert words(*results, *guides) <= 7000
    assert words(DOCS / "audit.md") <= 900
    assert words(DOCS / "README.md") <= 250
    assert words(*(DOCS / "adr").glob("*.md")) <= 900
