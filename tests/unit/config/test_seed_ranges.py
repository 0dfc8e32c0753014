"""Reset seeds: no purpose gets those of another, whatever the root seed, and what does not fit is refused."""

import re
from itertools import pairwise
from typing import Any

import pytest
from metric_docs import DOCUMENT
from recording_samples import make_episode, make_spec

from wm_nodes.config.load import ConfigError, load_config
from wm_nodes.config.measurement import EvaluationConfig
from wm_nodes.config.seed_ranges import (
    DEMONSTRATIONS,
    EVALUATION,
    MODEL_EPISODES,
    RANGES,
    ROUNDS,
    WEAK_POLICIES,
    demonstration_seeds,
    seed_spans,
)
from wm_nodes.config.tasks import WeakPolicy
from wm_nodes.environments.collection import CollectionPlan
from wm_nodes.environments.record import acceptance_plan, demonstration_plan
from wm_nodes.policy_rl.initial_policy import starts_plan
from wm_nodes.recording.episode_arrays import EpisodeArrays, stack_episodes

ROOT_SEEDS = [*range(1200), 4242, 2_145_582, 2_145_583, 20261127, 2**31 - 1, 2**40, 2**63 - 1]


def test_no_two_purposes_share_a_seed() -> None:
    ends = sorted((one.first, one.stop) for one in RANGES)
    assert all(first < stop for first, stop in ends)
    assert all(stop <= first for (_, stop), (first, _) in pairwise(ends))


def test_demonstrations_of_any_root_seed_are_no_seeds_of_another_purpose() -> None:
    config = load_config("base")
    others = [
        (plan.first_seed, plan.first_seed + plan.num_episodes)
        for plan in (acceptance_plan(config), starts_plan(config))
    ] + [(config.evaluation.first_seed, config.evaluation.first_seed + config.evaluation.episodes)]
    for root_seed in ROOT_SEEDS:
        plan = demonstration_plan(config.with_values(seed=root_seed), 1000)
        first, stop = plan.first_seed, plan.first_seed + plan.num_episodes
        assert all(stop <= other or end <= first for other, end in others), f"root seed {root_seed}"
        own = [one for one in RANGES if one.first < stop and first < one.stop]
        assert [one.purpose for one in own] == ["demonstrations"], f"root seed {root_seed}"


def test_the_first_hundred_root_seeds_have_the_demonstrations_they_always_had_and_no_two_runs_share_one() -> None:
    assert [demonstration_seeds(seed, 13) for seed in (0, 4, 99)] == [600_000, 604_000, 699_000]
    assert demonstration_seeds(100, 13) == 2_000_000 and demonstration_seeds(400, 13) == 2_300_000
    firsts = [demonstration_seeds(seed, 1000) for seed in range(1200)]
    assert len(set(firsts)) == 1200 and min(b - a for a, b in pairwise(sorted(firsts))) >= 1000


def test_more_seeds_than_a_range_or_a_block_holds_are_refused_with_the_setting_to_change() -> None:
    assert demonstration_seeds(3, 2000) == 603_000, "the last thousand are demonstrations of seed 4, too"
    assert demonstration_seeds(99, 2000) == 2_099_000, "too few are behind its block"
    with pytest.raises(ValueError, match=r"2000 demonstrations from reset seed 2147482000 on do not lie within 2000000 "
                                         r"to 2147483647.*change sft.num_demonstrations"):
        demonstration_seeds(2_145_582, 2000)
    with pytest.raises(ValueError, match=r"250001 episodes .* do not lie within 0 to 249999"):
        MODEL_EPISODES.take(250_001)
    assert WEAK_POLICIES.take(10_000, 18) == 490_000 and ROUNDS.take(5000, 19) == 895_000
    with pytest.raises(ValueError, match="have 19 blocks of reset seeds, and number 19 was asked for"):
        WEAK_POLICIES.take(1, 19)
    with pytest.raises(ValueError, match="number -1"):
        DEMONSTRATIONS.take(1, -1)


@pytest.mark.parametrize("first_seed", [0, 500_000, 600_400, 999_999, 2_000_000])
def test_an_evaluation_on_seeds_of_another_purpose_is_refused(first_seed: int) -> None:
    with pytest.raises(ConfigError, match="do not lie within 1000000 to 1999999"):
        load_config("cpu", {"evaluation.first_seed": first_seed})


def test_the_last_episode_of_an_evaluation_counts_too() -> None:
    given: dict[str, Any] = {"environment": "none", "first_seed": EVALUATION.stop - 200, "deterministic": True}
    assert EvaluationConfig(episodes=200, **given).episodes == 200
    with pytest.raises(ValueError, match="201 evaluation episodes from reset seed 1999800"):
        EvaluationConfig(episodes=201, **given)


@pytest.mark.parametrize(("first", "count"), [(999_999, 2), (1_500_000, 1), (0, 1_000_001), (-1, 1)])
def test_nothing_is_collected_on_seeds_of_the_evaluation(first: int, count: int) -> None:
    simulation = load_config("base").simulation
    with pytest.raises(ValueError, match="1000000 to 1999999 are those of the evaluation"):
        CollectionPlan("push_cube", simulation, count, first, {"expert": 1.0})
    assert CollectionPlan("push_cube", simulation, 3, 999_997, {"expert": 1.0}).num_episodes == 3


def test_the_document_lists_every_range() -> None:
    rows = re.findall(r"^- ([0-9,]+)–([0-9,]+): (.*)$", DOCUMENT.read_text(encoding="utf-8"), flags=re.M)
    listed = [(int(first.replace(",", "")), int(last.replace(",", "")) + 1, text) for first, last, text in rows]
    assert [(first, stop) for first, stop, _ in listed] == [(one.first, one.stop) for one in RANGES]
    assert all(f"{one.block:,}" in text for one, (_, _, text) in zip(RANGES, listed, strict=True) if one.block)


def test_spans_of_seeds_by_hand() -> None:
    assert seed_spans([5, 1, 2, 2, 3, 9]) == [[1, 3], [5, 5], [9, 9]]
    assert seed_spans([]) == []


def test_stacked_episodes_know_their_seeds_however_they_are_put_together() -> None:
    spec = make_spec()
    stacked = stack_episodes([make_episode(spec, row, seed=seed) for row, seed in enumerate((7, 310_000, 8))], ("a",),
                             num_steps=4)
    assert stacked.seeds == (7, 310_000, 8) and stacked.select([2, 0]).seeds == (8, 7)
    both = EpisodeArrays.concatenate([stacked.select([1]), stacked])
    assert seed_spans(both.seeds) == [[7, 8], [310_000, 310_000]]


def test_settings_that_no_range_has_seeds_for_are_refused_before_anything_is_collected() -> None:
    for name, value in (("data.num_episodes", 250_001), ("data.num_heldout", 100_001),
                        ("data.policy_episodes", 10_001)):
        with pytest.raises(ConfigError, match=name.split(".")[1]):
            load_config("cpu", {name: value})
    assert demonstration_seeds(99, 750 + 750 // 3) == 699_000
    with pytest.raises(ValueError, match="1001 demonstrations for weak policies"):
        WeakPolicy(0, 998, 0.25)
    with pytest.raises(ValueError, match="have 10 blocks"):
        WeakPolicy(10, 4, 0.25)
