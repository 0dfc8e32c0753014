"""Whether a model passes acceptance: measured on held-out real episodes, and by the policy that training begins with,
before that policy is trained in it (RS-12).

The numbers of held-out episodes come from open_loop.py: recorded actions rolled out open-loop from recorded first
frames. Positions are read off the imagined pictures by the judge's own probe; "copying" reads them off the first frame
instead. Where the policy sees the state alone, positions are those that states say. Those of the policy come from
rollouts of its own (policy_rl/validation/acceptance.py).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wm_nodes.config.schema import RunConfig
from wm_nodes.config.tasks import parts_of
from wm_nodes.core.statistics import newcombe_difference, wilson_of_share
from wm_nodes.core.types import BoolArray
from wm_nodes.recording.episode_arrays import EpisodeArrays
from wm_nodes.world_model import WorldModels
from wm_nodes.world_model.positions import judged_things
from wm_nodes.world_model.validation.acceptance_report import AcceptanceReport, Criterion, Outcome, at_step, number_of
from wm_nodes.world_model.validation.goals import goal_metrics
from wm_nodes.world_model.validation.open_loop import MOVED_M, evaluate_rollouts, imagine_episodes
from wm_nodes.world_model.validation.pictures import (
    ENOUGH,
    horizons_of,
    judged_horizon,
    picture_metrics,
    worst_varying_step,
)

MORE_TRAINING = (
    "train longer (world_model.num_iterations) or on more episodes near contact (data.num_episodes, data.behaviours)"
)
MORE_NEAR_MISSES = "collect more near misses (data.behaviours.near_miss), or raise reward.success_threshold"
MORE_SUCCESSES = "collect more successes (data.behaviours), or lower reward.success_threshold"
MORE_RECORDED = "train longer (tokenizer.num_iterations, world_model.num_iterations), or record more episodes"
RECORDED_NEAR_MISSES = "record more episodes that nearly succeed, or raise reward.success_threshold"
RECORDED_SUCCESSES = "record more episodes that succeed, or lower reward.success_threshold"
LOST_THINGS = "train the tokenizer longer (tokenizer.num_iterations), or with smaller patches (tokenizer.patch_px)"
OTHER_ACTIONS = "record episodes in which the robot does different things from alike first frames, or train longer"
POLICY_DATA = "refresh the model with more episodes of weak policies (data.policy_episodes)"
ROOM = "room to learn"
GOOD_ALREADY = (
    "keep this policy: it succeeds more often than what the model calls success is real; or refresh the model with its "
    "episodes (data.policy_episodes)"
)
BETTER_GOALS = "train the text model longer (world_model.text_num_iterations), or set reward.dense_weight to 0"


@dataclass(frozen=True)
class CloneRollouts:
    """What the policy that training begins with did in the model, and what its actions do in the simulator."""

    imagined: BoolArray
    """(E,), success by the model's own done signal."""
    replayed: BoolArray
    """(E,), success by the simulator, under the same actions."""
    held: BoolArray
    """(E,), the same where the robot then holds still for a few steps."""
    scenes: str = ""
    """Of the first frames, as simulation.scenes; empty: those that training begins in."""


def model_metrics(models: WorldModels, heldout: EpisodeArrays, config: RunConfig) -> dict[str, float]:
    """Return the metrics of rollouts of held-out actions against the recordings; see open_loop.evaluate_rollouts, and
    pictures.picture_metrics where no positions are known."""
    threshold, imagined = config.reward.success_threshold, imagine_episodes(models.tokenizer, models.action, heldout)
    metrics = evaluate_rollouts(
        models.tokenizer, imagined, heldout, threshold=threshold, probe=models.probe,
        state_names=models.spec.state_names if _sees_states(models, config) else (),
    )
    return metrics if _has_positions(metrics) else metrics | picture_metrics(models, imagined, heldout)


def _sees_states(models: WorldModels, config: RunConfig) -> bool:
    """Whether the policy sees nothing of the pictures, and a model of states moves what it sees."""
    return config.policy.inputs == "state" and models.action.state_model is not None


def accept_world_model(
    models: WorldModels, heldout: EpisodeArrays, config: RunConfig, imagined: tuple[int, int] | None = None,
    real: tuple[int, int] | None = None, clone: Sequence[CloneRollouts] = (),
) -> AcceptanceReport:
    """Measure whether a world model passes acceptance for config.task.

    Args:
        heldout: real episodes that the model was not trained on; without ground truth, positions are not judged.
        imagined, real: (successes, episodes) of the SFT policy in the model and in the simulator; None: not measured.
        clone: of the SFT policy, each of other scenes; empty: not measured.

    Raises:
        ValueError: some episodes without ground truth, or labelled for other tasks than the model's.
    """
    config = config if config.task else config.model_copy(update={"task": models.spec.task})
    _check(models, heldout, config.task)
    metrics = model_metrics(models, heldout, config)
    told = _sees_states(models, config)
    criteria, notes = apply_criteria(metrics, config, heldout.num_steps, imagined, real, clone, told=told)
    if config.reward.dense_weight > 0 and models.text is not None:
        for part in parts_of(config.task):
            goals = goal_metrics(models, heldout, config, part)
            criteria = (*criteria, *_goals(goals, config, part))
            metrics |= {f"{part}_{name}": value for name, value in goals.items()}
    return AcceptanceReport(config.task, len(heldout), criteria, metrics, notes)


def apply_criteria(
    metrics: Mapping[str, float | None], config: RunConfig, num_steps: int, imagined: tuple[int, int] | None,
    real: tuple[int, int] | None, clone: Sequence[CloneRollouts] = (), *, told: bool = False,
) -> tuple[tuple[Criterion, ...], tuple[str, ...]]:
    """Return criteria and notes from the metrics of rollouts of up to num_steps steps; see accept_world_model.

    Args:
        told: positions are those of states, of the tool the commanded ones, which no model predicts.
    """
    limits, task = config.acceptance, config.task
    has_positions = _has_positions(metrics)
    near_misses, successes = MORE_NEAR_MISSES, MORE_SUCCESSES
    if has_positions:
        criteria, notes = _position_criteria(metrics, config, num_steps, told)
    else:
        criteria, notes = [], ["Positions were not judged: no ground truth names them."]
        near_misses, successes = RECORDED_NEAR_MISSES, RECORDED_SUCCESSES
    precision = "precision" if has_positions else "in_time"  # elsewhere the clone's replays show when it is paid
    for kind, threshold, remedy in (
        (precision, limits.done_precision, near_misses), ("recall", limits.done_recall, successes),
    ):
        value, interval = _mean_of_parts(metrics, parts_of(task), kind)
        said = "precision in time" if kind == "in_time" else kind
        name = f"done {said} on rollouts" + (", mean of the tasks" if len(parts_of(task)) > 1 else "")
        outcome: Outcome = "passed" if value >= threshold else "failed"
        rule = ">="
        if not has_positions:  # a stranger's recordings may be few
            outcome, rule = _of_interval(value, *(interval or (0.0, 1.0)), threshold, limits.success_margin)
        criteria.append(Criterion(name, value, threshold, rule, outcome, remedy, interval))
    if not has_positions:
        of_pictures, more = _picture_criteria(metrics, config, num_steps)
        criteria, notes = criteria + of_pictures, notes + more
    policy, more = _policy_criteria(config, imagined, real, clone)
    return (*criteria, *policy), (*notes, *more)


def _has_positions(metrics: Mapping[str, float | None]) -> bool:
    return any(name.startswith("tool_") for name in metrics)


def _picture_criteria(
    metrics: Mapping[str, float | None], config: RunConfig, num_steps: int
) -> tuple[list[Criterion], list[str]]:
    """Criteria and notes of what is known by pictures alone, see pictures.picture_metrics."""
    step, auc = judged_horizon(metrics), number_of(metrics.get(f"done_{config.task}_auc"))
    notes = [f"AUC of the done signal: {auc:.2f}, chance is 0.5." if math.isfinite(auc)
             else "AUC of the done signal was not judged: all held-out episodes succeed, or none."]
    if not step:
        return [], [*notes, "Pictures of rollouts were not judged: nothing was measured."]
    ratio, *ends = (at_step(metrics, f"feature_ratio{end}", step) for end in ("", "_low", "_high"))
    name, limit = f"feature distance / copying, step {step}", config.acceptance.feature_error_ratio
    criteria = [_below(name, ratio, limit, _interval(*ends), MORE_RECORDED)]
    ratio, low, high = (at_step(metrics, f"other_actions{end}", step) for end in ("", "_low", "_high"))
    if math.isfinite(low):
        limit = config.acceptance.other_actions_ratio
        outcome, rule = _of_interval(ratio, low, high, limit, limit - 1)
        name = f"feature distance, other / recorded actions, step {step}"
        criteria.append(Criterion(name, ratio, limit, rule, outcome, OTHER_ACTIONS, (low, high)))
    else:
        notes.append("Sensitivity to actions was not judged: no two held-out episodes differ in their actions.")
    if (worst := worst_varying_step(metrics)) is not None:
        name, value = f"varying pixels, unexplained, step {worst}", at_step(metrics, "varying_error", worst)
        criteria.append(_below(name, value, config.acceptance.varying_error_ratio, None, LOST_THINGS))
    else:
        notes.append(f"What the tokenizer loses was not judged: fewer than {ENOUGH} episodes are held out, or their "
                     "pictures do not differ.")
    if step < num_steps:
        notes.append(f"Pictures were judged up to step {step}, which half of the held-out episodes reach; imagined "
                     f"episodes have up to {num_steps}.")
    return criteria, notes


def _position_criteria(
    metrics: Mapping[str, float | None], config: RunConfig, num_steps: int, told: bool
) -> tuple[list[Criterion], list[str]]:
    """Criteria and notes of the errors of positions after num_steps steps."""
    things = {*judged_things(config.task)} - ({"tool"} if told else set())
    limits, task, criteria = config.acceptance, config.task, list[Criterion]()
    notes = [
        f"Errors are those of the full horizon over those of copying the first frame; the object's over the episodes "
        f"in which it moved more than {100 * MOVED_M:g} cm; the probe alone errs by "
        f"{at_step(metrics, 'object_floor_cm', num_steps):.2f} cm (object) and "
        f"{at_step(metrics, 'tool_floor_cm', num_steps):.2f} cm (tool) on real frames."
    ]
    if "object" not in things:
        notes.append(f"The object hardly moves in {task}, so its error is not judged.")
    if told:
        notes.append("The tool's error is not judged: its place is the commanded one, which no model predicts.")
    for name, key, limit in (
        ("object", "object_moved_ratio", limits.object_error_ratio), ("tool", "tool_ratio", limits.tool_error_ratio),
    ):
        if name in things:
            ratio, *ends = (at_step(metrics, f"{key}{end}", num_steps) for end in ("", "_low", "_high"))
            criteria.append(_below(f"{name} error / copying, step {num_steps}", ratio, limit, _interval(*ends)))
    return criteria, notes


def accept_video_model(
    config: RunConfig, imagined: tuple[int, int], real: tuple[int, int], clone: Sequence[CloneRollouts] = ()
) -> AcceptanceReport:
    """Judge a model that cannot be rolled out as accept_world_model does, by what the SFT policy does in it alone."""
    criteria, notes = _policy_criteria(config, imagined, real, clone)
    told = ("Errors of the frames were not judged: the model is no world model.", *notes)
    return AcceptanceReport(config.task, 0, tuple(criteria), {}, told)


def report_when_made(
    manifest: Mapping[str, Any], config: RunConfig, imagined: tuple[int, int] | None = None,
    real: tuple[int, int] | None = None,
) -> AcceptanceReport:
    """What the held-out metrics in a world model's manifest mean for config.task, or the model's own where it is empty,
    without a simulator; without such metrics there are no criteria of them. imagined, real: as accept_world_model."""
    spec, held = manifest.get("spec", {}), manifest.get("heldout", {})
    task, steps = config.task, config.simulation.max_episode_steps
    if not task:
        task, steps = spec["task"], spec["max_episode_steps"]
        config = config.model_copy(update={"task": task})
    metrics = held.get(task, held)
    if f"tool_ratio_h{steps:02d}" not in metrics and not horizons_of(metrics):
        of_policy, left_out = _policy_criteria(config, imagined, real)
        note = f"the model's manifest holds no metrics of held-out episodes of {task}"
        return AcceptanceReport(task, 0, tuple(of_policy), {}, (note, *left_out))
    told = config.policy.inputs == "state" and bool(manifest.get("world_model", {}).get("state_model_iterations"))
    criteria, notes = apply_criteria(metrics, config, steps, imagined, real, told=told)
    if config.reward.dense_weight > 0 and "goal_episodes" in metrics:
        criteria = (*criteria, *_goals({name: number_of(value) for name, value in metrics.items()}, config, task))
    if manifest.get("success_threshold") != config.reward.success_threshold:
        criteria = tuple(row for row in criteria if not row.name.startswith("done"))
        at = f"reward.success_threshold {config.reward.success_threshold:g}"
        notes = (f"The done signal at {at} was not judged.", *notes)
    return AcceptanceReport(task, int(metrics.get("episodes") or 0), criteria, {}, notes)


def accepted_when_made(manifest: Mapping[str, Any], config: RunConfig) -> str:
    """Say report_when_made in a line."""
    report, left_out = report_when_made(manifest, config), "the policy in it"
    if not report.episodes:
        return f"not judged: {report.notes[0]}"
    if manifest.get("success_threshold") != config.reward.success_threshold:
        left_out = f"its done signal at reward.success_threshold {config.reward.success_threshold:g} and {left_out}"
    return (f"{report.words} on {report.episodes} held-out episodes when it was made; {left_out} not judged, without a "
            "simulator")


def _policy_criteria(
    config: RunConfig, imagined: tuple[int, int] | None, real: tuple[int, int] | None,
    clone: Sequence[CloneRollouts] = (),
) -> tuple[list[Criterion], list[str]]:
    """Criteria and notes of what the SFT policy does in the model."""
    limits, criteria, notes = config.acceptance, list[Criterion](), list[str]()
    if not clone:
        notes.append("The done signal was not judged on rollouts of the cloned policy: none were made.")
    for found in clone:
        who = f"cloned policy, {found.scenes}" if found.scenes else "cloned policy"
        right, seen = found.replayed[found.imagined], found.imagined[found.replayed]
        criteria += [
            _of_clone(f"precision, {who}", right, limits.done_precision, config, MORE_NEAR_MISSES),
            _of_clone(f"recall, {who}", seen, limits.done_recall, config, MORE_SUCCESSES),
        ]
        if not found.scenes and real is not None and 2 * real[0] >= real[1]:
            criteria.append(_room(right, real, limits.success_margin))
    if not limits.require_success_agreement:
        notes.append("Agreement of imagined and real success was not asked for (acceptance.require_success_agreement).")
    elif imagined is None or real is None:
        notes.append("Agreement of imagined and real success was not judged: no policy was measured in both.")
    else:
        criteria.append(_agreement(imagined, real, limits.success_margin))
    return criteria, notes


def _agreement(imagined: tuple[int, int], real: tuple[int, int], margin: float) -> Criterion:
    """An equivalence test: the interval within the margin passes; a gap beyond it, and beyond chance, fails."""
    low, high = newcombe_difference(*imagined, *real)
    gap = imagined[0] / imagined[1] - real[0] / real[1]
    name = f"SFT policy: imagined {imagined[0]}/{imagined[1]} - real {real[0]}/{real[1]} success"
    outcome: Outcome = "undecided"
    if -margin <= low and high <= margin:
        outcome = "passed"
    elif abs(gap) > margin and not low <= 0 <= high:
        outcome = "failed"
    rule = f"interval within +-{margin:g}"
    return Criterion(name, gap, None, rule, outcome, POLICY_DATA, (low, high))


def _room(right: BoolArray, real: tuple[int, int], margin: float) -> Criterion:
    """Whether training can raise a policy that mostly succeeds: RL turns it to what the model calls a success, so that
    its real success goes towards the share of its imagined successes that are real. It fails where that share is lower
    than what it has and the interval leaves no gain above the margin, so that a good policy is kept; few episodes
    decide nothing. A weaker policy is far from there: RL raised such against this rule (docs/results/policy_rl.md)."""
    gap = float(right.mean()) - real[0] / real[1] if len(right) else math.nan
    low, high = newcombe_difference(int(right.sum()), len(right), *real)
    outcome: Outcome = "undecided"
    if gap < 0 and high <= margin:
        outcome = "failed"
    elif gap >= 0 and low >= -margin:
        outcome = "passed"
    name = f"{ROOM}: done precision, cloned policy - its real success {real[0]}/{real[1]}"
    return Criterion(name, gap, 0.0, f"interval above {-margin:g}, value >=", outcome, GOOD_ALREADY, (low, high))


def _of_clone(what: str, right: BoolArray, limit: float, config: RunConfig, remedy: str) -> Criterion:
    """See _of_interval."""
    value, low, high = wilson_of_share(right)
    outcome, rule = _of_interval(value, low, high, limit, config.acceptance.success_margin)
    return Criterion(f"done {what} ({len(right)})", value, limit, rule, outcome, remedy, (low, high))


def _of_interval(value: float, low: float, high: float, limit: float, margin: float) -> tuple[Outcome, str]:
    """Outcome and rule of a value with its interval: it fails where even the upper end misses the limit, and passes
    where the lower end is within the margin of it."""
    near = limit - margin
    outcome: Outcome = "undecided"
    if high < limit:
        outcome = "failed"
    elif value >= limit and low >= near:
        outcome = "passed"
    return outcome, f"interval above {near:.2f}, value >="


def _goals(found: Mapping[str, float], config: RunConfig, part: str) -> list[Criterion]:
    """Of the goals that the text model imagines for one task."""
    limits, of = config.acceptance, f"imagined goal of {part}"
    if not found.get("goal_episodes"):
        return [Criterion(f"{of}: episodes that reach it", 0.0, 1.0, ">=", "undecided", MORE_SUCCESSES)]
    share = found["goal_found"]
    outcome: Outcome = "passed" if share >= limits.done_recall else "failed"
    ends = _interval(found["goal_found_low"], found["goal_found_high"])
    criteria = [Criterion(f"{of}: found", share, limits.done_recall, ">=", outcome, BETTER_GOALS, ends)]
    places = [name for name in sorted(judged_things(part)) if f"goal_{name}_cm" in found]
    for name, unit in ((name, "_cm") for name in places) if places else (("perceptual", ""),):
        copied = found[f"goal_{name}_copy{unit}"]
        ratio = found[f"goal_{name}{unit}"] / copied if copied > 0 else math.nan
        ends = _interval(found[f"goal_{name}_ratio_low"], found[f"goal_{name}_ratio_high"])
        criteria.append(_below(f"{of}: {name} error / first frame", ratio, limits.goal_error_ratio, ends, BETTER_GOALS))
    return criteria


def _mean_of_parts(
    metrics: Mapping[str, float | None], parts: tuple[str, ...], kind: str
) -> tuple[float, tuple[float, float] | None]:
    """Mean over the parts whose value is known, and its interval, from those of the parts (MOVER)."""
    rows = [[number_of(metrics.get(f"done_{part}_{kind}{end}")) for end in ("", "_low", "_high")] for part in parts]
    known = [row for row in rows if math.isfinite(row[0])]
    if not known:
        return math.nan, None
    value = float(np.mean([row[0] for row in known]))
    below, above = (math.hypot(*(row[0] - row[end] for row in known)) / len(known) for end in (1, 2))
    return value, _interval(value - below, value + above)


def _below(
    name: str, value: float, threshold: float, interval: tuple[float, float] | None, remedy: str = MORE_TRAINING
) -> Criterion:
    outcome: Outcome = "passed" if value <= threshold else "failed"
    return Criterion(name, float(value), threshold, "<=", outcome, remedy, interval)


def _interval(low: float, high: float) -> tuple[float, float] | None:
    return (low, high) if math.isfinite(low) and math.isfinite(high) else None


def _check(models: WorldModels, heldout: EpisodeArrays, task: str) -> None:
    for part in parts_of(task):
        models.task_index(part)
    if heldout.tasks != models.tasks:
        raise ValueError(
            f"held-out episodes are labelled for {', '.join(heldout.tasks)}, the world model knows "
            f"{', '.join(models.tasks)}; stack them with the tasks of the model's manifest"
        )
    unknown = int(np.isnan(heldout.ground_truth).reshape(len(heldout), -1).any(1).sum())
    if unknown:
        raise ValueError(
            f"{unknown} of {len(heldout)} held-out episodes carry no ground truth, so positions cannot "
            "be compared; measure on simulator episodes (environments/record.py), not on imagined or real-robot ones"
        )
