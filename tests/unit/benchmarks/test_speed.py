"""The benchmark's own parts: what it counts and how it alternates."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from benchmarks.speed import speed
from benchmarks.speed.inputs import actions_of, interleave, prepare_model, random_model, seeds_of
from benchmarks.speed.noop_environment import make_noop_environment
from benchmarks.speed.simulator import imagined_contender, rate_episode
from benchmarks.speed.stages import fresh_pictures
from wm_nodes.apps.cli import main
from wm_nodes.config.load import load_config
from wm_nodes.reward import RuleReward


def test_contenders_alternate_and_the_first_block_does_not_count() -> None:
    order: list[str] = []

    def contender(name: str, block: int) -> int:
        order.append(f"{name}{block}")
        return block

    found = interleave([lambda block: contender("a", block), lambda block: contender("b", block)], 2)
    assert order == ["a0", "b0", "a1", "b1", "a2", "b2"]
    assert found == [[1, 2], [1, 2]]


def test_pictures_of_the_reward_stage_are_never_seen_twice() -> None:
    images = np.zeros((2, 8, 8, 3), np.uint8)
    seen = [pictures.tobytes() for pictures in itertools.islice(fresh_pictures(images), 600)]
    assert len(set(seen)) == len(seen)
    assert not images.any()


def test_the_costless_environment_never_ends_so_that_every_step_counts() -> None:
    env = make_noop_environment(load_config("cpu", {}), 4, 0)
    env.reset(None, seeds_of(env.spec, 0))
    for actions in actions_of(env.spec, 0, 3 * env.spec.max_episode_steps):
        assert env.step(actions).valid.all()
    assert rate_episode(env, RuleReward(), 1) > 0


def test_a_model_of_states_is_measured_as_rl_uses_it(tmp_path: Path) -> None:
    config = load_config("smoke", {
        "task": "push", "simulation.object_state": "truth", "policy.inputs": "state",
        "world_model.state_model_iterations": 1, "reward.success_threshold": 1.0,
    })
    folder = random_model(config, tmp_path / "model")
    model, starts, _ = prepare_model(config, tmp_path, folder)
    rates = []
    for inputs in ("state", "latents"):
        its = config.with_values(policy=config.policy.with_values(inputs=inputs))
        contender = imagined_contender(its, model, starts)
        rates.append(max(contender(block) for block in range(3)))
    assert rates[0] > rates[1] > 0


def test_a_simulator_that_was_not_measured_is_shown_with_the_reason_and_no_number(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(speed, "console", Console(width=200))
    times = ("dds_step", "in_process_step", "growth_first", "growth_last", "growth_first_p10", "growth_last_p10")
    graph = {"num_envs": 16, "image": "64x128", "threads_each": 1, "overhead_95": (1.0, 1.1), "pairs": 3,
             "growth_steps": 9, **{f"{name}_ms": 1.0 for name in times}}
    found = {
        "machine": {"processor": "one", "cores": 2}, "date": "today", "model": "small", "graph": graph,
        "graph_overhead": 1.0, "step_growth": 1.0, "imagined_steps_per_s": 640.0, "imagined_over_simulator": 6.4,
        "imagined_over_stock_simulator": None, "stages": {},
        "simulator": {"missing": "", "simulator_processes": 2, "simulator_steps_per_s": 100.0, "imagined_envs": 64,
                      "reward": "endogenous"},
    }
    speed.show(found)
    ours, stock = (line for line in capsys.readouterr().out.splitlines() if "imagined_over" in line)
    assert "6.4" in ours and "2 processes: 100.0 steps/s" in ours
    assert "-" in stock and "ManiSkill has no such task" in stock
    simulator = found["simulator"] | {"missing": "no Vulkan device"}
    speed.show(found | {"imagined_over_simulator": None, "simulator": simulator})
    assert capsys.readouterr().out.count("no Vulkan device") == 2


@pytest.mark.parametrize(
    ("value", "words"),
    [("world_model.width=7", "world_model.width 7"), ("world_model.widht=96", "widht"),
     ("world_model.width", "expected a value behind")],
)
def test_an_untrained_model_of_an_impossible_size_is_refused_before_anything_is_measured(
    value: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["benchmark", "speed", "--preset", "smoke", "--untrained", f"--{value}"]) == 2
    assert words in capsys.readouterr().err


def test_settings_without_an_untrained_model_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "speed", "--world_model.width", "96"]) == 2
    assert "are of a model with random weights" in capsys.readouterr().err
