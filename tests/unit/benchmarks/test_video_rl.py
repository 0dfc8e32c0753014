"""The DynDiff benchmark: fair plans, honest intervals, an alarm that a hacked reward raises, and its command."""

import hashlib
import json
import shlex
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from rich.console import Console

from benchmarks.video_rl import cost
from benchmarks.video_rl.clock import clocked
from benchmarks.video_rl.comparison import GAINS, compare_samplers, gains, value
from benchmarks.video_rl.cost import ANCHORS, toy_rollout
from benchmarks.video_rl.learning import hacked, train_on_discs, train_sampler
from benchmarks.video_rl.samplers import LEARNER, DiscPlan, SamplerSetup, dyndiff, learning_samplers, sampler_setup
from benchmarks.video_rl.sources import DiscSource, sample_scenes
from benchmarks.video_rl.spread import group_spread
from benchmarks.video_rl.tables import gain_table
from benchmarks.video_rl.trials import ablation_trials, hacking_trials
from wm_nodes.apps.cli import main
from wm_nodes.config.shipped import PRETRAINED
from wm_nodes.video_model import RolloutBuffer
from wm_nodes.video_rl.toy_scene import BASE, SceneRequest, draw_scenes, load_base

SHORT = DiscPlan(iterations=2, contexts=1, eval_contexts=4, eval_every=1)


def training(sampler: str, seed: int, *rewards: float) -> dict[str, Any]:
    points = [{"iteration": i, "reward": value, "obeyed": 0.5, "background": 0.001} for i, value in enumerate(rewards)]
    plan = {"iterations": len(rewards) - 1, "eval_every": 1}
    return {"sampler": sampler, "seed": seed, "plan": plan, "evaluations": points}


# intervals


def test_arms_are_compared_on_their_common_seeds_over_the_path_and_at_the_end() -> None:
    rows = [
        training("CPS", 0, 0.1, 0.3, 0.5), training("CPS", 1, 0.2, 0.2, 0.4), training("CPS", 2, 0, 0, 9),
        training("new", 1, 0.2, 0.4, 0.5), training("new", 0, 0.1, 0.5, 0.6), training("new", 7, 0, 9, 9),
    ]
    found = compare_samplers(rows, "new", "CPS")
    assert found is not None and found.seeds == (0, 1)
    assert found.differences["reward"].mean == pytest.approx(0.1)
    assert found.differences["reward_path"].mean == pytest.approx((0.15 + 0.15) / 2)
    assert value(rows[0], "reward_path") == pytest.approx(0.4), "what every sampler starts from does not count"
    assert compare_samplers(rows, "new", "other") is None


def test_the_gain_of_a_training_is_its_end_less_its_start_with_the_interval_over_seeds() -> None:
    """Gains 1, 2, 3 from three different starts: 2 -+ 4.303 / sqrt(3); of one seed there is no interval."""
    rows = [
        training("CPS", 0, 5, 5.5, 6), training("CPS", 1, 0, 9, 2), training("CPS", 2, 1, 1, 4),
        training("one", 0, 1, 3),
    ]
    assert gains(rows[:2], "reward") == [[0, 0.5, 1], [0, 9, 2]]
    for row in rows:
        row["evaluations"] = [{**dict.fromkeys(GAINS, 0.0), **point} for point in row["evaluations"]]
    console = Console(width=300)
    with console.capture() as printed:
        console.print(gain_table(rows))
    three, one = (
        [cell.strip() for cell in line.split("│")] for line in printed.get().splitlines() if line.startswith("│")
    )
    assert three[1:4] == ["CPS", "3", "2.000 +2.0000 (-0.4843, +4.4843)"] and one[1:4] == ["one", "1", "1.000 +2.0000"]
    assert three[5] == "0.500 +0.0000 (+0.0000, +0.0000)", "obeyed never changed"


# plans


def test_every_training_of_an_ablation_makes_the_model_calls_of_its_base() -> None:
    trials, pairs = ablation_trials(LEARNER, DiscPlan(iterations=20))
    calls = {}
    for trial in trials:
        videos = trial.plan.iterations * trial.plan.contexts * trial.plan.group_size
        calls[trial.sampler.name] = videos * (1 if trial.sampler.rollout.cfg == 1 else 2)
    assert all(calls[name] == calls[base] for name, base in pairs) and len(pairs) == 5
    by_name = {trial.sampler.name: trial for trial in trials}
    guided = by_name["guidance 2"].sampler
    assert guided.rollout.cfg == 2
    for name, base in pairs:
        named = replace(by_name[base].sampler, name=name)
        assert by_name[name] != replace(by_name[base], sampler=named), "nothing is compared"


def test_a_window_makes_its_own_steps_stochastic_and_trains_as_many_as_the_others() -> None:
    samplers = {sampler.name: sampler for sampler in learning_samplers(LEARNER)}
    assert len(samplers) == len(learning_samplers(LEARNER)), "names are unique"
    mix, flow = samplers["Mix-GRPO 0.7"], samplers["Flow-GRPO 0.7"]
    scenes, model = draw_scenes(1, 0, "test"), load_base()
    windows = [sample_scenes(model, mix, scenes, 2, 0, i).rollout.steps for i in (0, 7, 39)]
    assert windows == [(0, 1, 2, 3), (1, 2, 3, 4), (5, 6, 7, 8)]
    assert int(mix.grpo.step_fraction * 4) == int(flow.grpo.step_fraction * 9)


def test_guidance_and_resolution_of_an_evaluation_are_those_of_its_arm_and_plan() -> None:
    model, sampler = load_base(), sampler_setup("CPS", dyndiff(0.6))
    guided = replace(sampler, rollout=sampler.rollout.with_values(cfg=2.0))
    plan = DiscPlan(eval_contexts=32)

    def evaluate(sampler: SamplerSetup, plan: DiscPlan) -> dict[str, float]:
        found = DiscSource(model, sampler, plan, 0).validate()
        return {name: sum(values) / len(values) for name, values in found.items()}

    plain, strong = evaluate(sampler, plan), evaluate(guided, plan)
    assert strong["obeyed"] > plain["obeyed"] + 0.05, "guidance follows the command more often"
    assert evaluate(sampler, replace(plan, eval_side=20))["background"] != plain["background"]


# hacking


def test_a_reward_that_is_bought_with_too_much_mass_is_named_and_mass_that_becomes_right_is_not() -> None:
    def rising(*masses: float) -> list[dict[str, float]]:
        return [
            {"reward": 0.1 * i, "mass": mass, "obeyed": 0.5 + 0.01 * i, "background": 0.001}
            for i, mass in enumerate(masses)
        ]

    assert hacked(rising(1.02, 1.2, 1.38, 1.55), "reward") == ["mass"]
    assert hacked(rising(0.8, 0.87, 0.94, 1.0), "reward") == []
    assert hacked(rising(1.5, 1.3, 1.2, 1.1), "reward") == []


@pytest.mark.slow
def test_the_detector_names_what_a_hackable_reward_destroys_and_under_the_honest_one_the_background_at_most() -> None:
    """Temporal consistency rises because the disc fades: it obeys less and has less mass."""
    plan = DiscPlan(iterations=8, contexts=3, eval_contexts=32, eval_every=2)
    honest, hackable, _ = hacking_trials(LEARNER, plan)
    trained = [
        train_on_discs(load_base(), replace(sampler, grpo=sampler.grpo.with_values(learning_rate=3e-4)), plan, seed=0)
        for sampler, plan in ((trial.sampler, trial.plan) for trial in (honest, hackable))
    ]
    assert {*trained[0]["hacked"]} <= {"background"} and {"obeyed", "mass"} <= {*trained[1]["hacked"]}
    first, last = trained[1]["evaluations"][0], trained[1]["evaluations"][-1]
    assert last["consistency"] > first["consistency"] + 0.05 and last["mass"] < first["mass"] - 0.2


# command


@pytest.mark.slow
def test_ablations_go_on_where_their_file_stops_and_refuse_another_plan(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "ablations.json"
    short = ["--iterations", "1", "--scenes", "1", "--eval-scenes", "2", "--json", str(path)]
    assert main(["benchmark", "ablations", "--seeds", "0", *short]) == 0
    first = json.loads(path.read_text())
    assert main(["benchmark", "ablations", "--seeds", "0", "1", *short]) == 0
    both = json.loads(path.read_text())
    assert both["rows"][: len(first["rows"])] == first["rows"] and len(both["rows"]) == 2 * len(first["rows"])
    assert [row["base"] for row in both["comparisons"]].count("base") == 3 and not first["comparisons"]
    assert main(["benchmark", "ablations", "--seeds", "0", *short, "--iterations", "2"]) == 2
    assert "take another file" in capsys.readouterr().err


SHORT_CALL = ["--iterations", "1", "--scenes", "1", "--eval-scenes", "2", "--seeds", "0", "1"]
CALLS = {
    "diversity": ["--contexts", "2", "--group-size", "2", "--samplers", "ODE", "CPS 0.2", "DynDiff 0.2 sparse, rms"],
    "learning": [*SHORT_CALL, "--samplers", "CPS 0.6", "DynDiff 0.6 gated"],
    "ablations": [*SHORT_CALL, "--samplers", "base", "no KL"],
    "hacking": [*SHORT_CALL, "--samplers", "honest reward"],
    "cost": ["--repeats", "1"],
}


@pytest.mark.slow
@pytest.mark.parametrize("experiment", CALLS)
def test_every_file_says_how_it_was_made(
    experiment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cost, "SCENES", 1)
    monkeypatch.setattr(cost, "GROUP", 4)
    path = tmp_path / f"{experiment}.json"
    call = ["benchmark", experiment, *CALLS[experiment], "--json", str(path)]
    assert main(call) == 0
    found = json.loads(path.read_text())
    assert found["command"] == shlex.join(["wm", *call])
    assert found["sha256"]["base"] == hashlib.sha256(BASE.read_bytes()).hexdigest()
    if experiment == "cost":
        assert {(row["model"], row["anchor"]) for row in found["rows"]} == {
            (model, anchor) for model in ("moving disc", "PushCube") for anchor in ANCHORS
        }
        assert found["learner"]["kl"]["beta"] == LEARNER.kl.beta
        kl = {(row["model"], row["anchor"]): row["kl_s"] / row["forward_s"] for row in found["rows"]}
        assert all(kl[model, "buffer"] < 0.1 < kl[model, "frozen"] for model in ("moving disc", "PushCube"))
    else:
        assert {sampler["name"] for sampler in found["samplers"]} == {row["sampler"] for row in found["rows"]}
        assert all(sampler["rollout"]["num_steps"] == 10 and sampler["grpo"]["kl"] for sampler in found["samplers"])


def test_a_training_keeps_the_spread_of_its_rollouts_and_the_noise_of_the_steps_in_a_window() -> None:
    sampler = {sampler.name: sampler for sampler in learning_samplers(LEARNER)}["CPS 0.6, window"]
    moving = replace(sampler, window=sampler.window.with_values(period=1))
    found = train_on_discs(load_base(), moving, SHORT, seed=0)["buffers"]
    assert found["noise_share"] == pytest.approx([0.809] * 2, abs=1e-3)
    assert all(0 < value < 2 for value in found["rollout_diversity"])
    buffer = sample_scenes(load_base(), moving, draw_scenes(2, 0, "test"), 3, 0)
    rewards = torch.tensor([1.0, 2, 3, 5, 5, 5], dtype=torch.float64)
    spread = group_spread(buffer.with_rewards({"total": rewards}), 3)
    assert spread["rollout_reward_std"] == pytest.approx((2 / 3) ** 0.5 / 2) and spread["rollout_diversity"] > 0.01
    alike = replace(buffer.rollout, latents=buffer.rollout.latents[::3].repeat_interleave(3, 0))
    equal = replace(buffer, rollout=alike).with_rewards({"total": rewards})
    assert group_spread(equal, 3)["rollout_diversity"] == pytest.approx(0, abs=1e-6)


def test_a_training_ends_where_every_clip_is_paid_the_same() -> None:
    class Equal(DiscSource):
        def score(self, request: SceneRequest, clips: RolloutBuffer) -> RolloutBuffer:
            return clips.with_rewards({"total": torch.ones(len(clips), dtype=torch.float64)})

    sampler, plan = learning_samplers(LEARNER)[0], replace(SHORT, iterations=9, eval_every=3)
    found = train_sampler(Equal(load_base(), sampler, plan, 0), sampler, plan, seed=0)
    assert found["buffers"]["skipped"] == [1, 2, 3, 4]
    assert [one["iteration"] for one in found["evaluations"]] == [0, 3, 4]


def test_a_clock_counts_the_time_inside_the_functions_it_names_and_leaves_them_as_they_were() -> None:
    module = ModuleType("module")
    module.slow = slow = lambda seconds: time.sleep(seconds)  # type: ignore[attr-defined]
    with clocked(module, "slow") as spent:
        module.slow(0.02)
        module.slow(0.01)
        time.sleep(0.2)
    assert 0.03 <= spent[0] < 0.2 and module.slow is slow


def test_a_rollout_reports_the_share_of_its_mask_and_of_its_caching() -> None:
    found = toy_rollout(load_base(), repeats=1, seed=0)
    assert 0.005 < found["mask_share"] < 0.3 and 0.0001 < found["cache_share"] < 0.1
    assert found["over_cps"] == pytest.approx(found["rollout_s"] / found["cps_s"])


def test_a_file_of_another_experiment_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "learning.json"
    path.write_text(json.dumps({"rows": [{"arm": "CPS 0.6", "seed": 0, "plan": {"scenes": 6}}]}))
    assert main(["benchmark", "learning", "--samplers", "CPS 0.6", "--json", str(path)]) == 2
    assert "holds rows of another experiment; take another file" in capsys.readouterr().err


def test_an_unknown_arm_is_refused_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "learning", "--samplers", "CPS 7"]) == 2
    assert "unknown samplers CPS 7" in capsys.readouterr().err


def test_a_training_that_ends_early_keeps_what_it_reached_to_the_end_of_its_path() -> None:
    """Of three planned evaluations: 0.5, 1 and then 1 again, not 0.5 and 1 alone."""
    plan = {"iterations": 15, "eval_every": 5}
    early, whole = ({"plan": plan, "evaluations": [{"success": one} for one in course]}
                    for course in ((0.0, 0.5, 1.0), (0.0, 0.5, 1.0, 1.0)))
    assert value(early, "success_path") == value(whole, "success_path") == pytest.approx(2.5 / 3)
    assert value(early, "success") == 1


def test_a_base_of_another_architecture_and_a_count_of_zero_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    other = PRETRAINED / "table_top_cube" / "video_model" / "network.safetensors"
    assert main(["benchmark", "diversity", "--base-model", str(other)]) == 2
    assert "of another architecture" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["benchmark", "diversity", "--contexts", "0"])
    assert "'0' is no whole number from 1 on" in capsys.readouterr().err
