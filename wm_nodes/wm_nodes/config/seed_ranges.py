"""Reset seeds of simulator episodes: a range for each purpose, so that nothing is measured on what was learned from.

No two ranges of RANGES meet, so no root seed (`--seed`) and no number of episodes brings a seed of one purpose into
another: what does not fit is refused. Policy RL resets with any seed below EVALUATION. In a model such a seed only
chooses a start; in the simulator it may show a scene on which models are judged, but never one of the evaluation.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class SeedRange:
    """Reset seeds `first` to `stop` - 1 of one purpose."""

    purpose: str
    """In words."""
    first: int
    """The first one."""
    stop: int
    """The one after the last."""
    settings: str
    """What asks for more or fewer of them."""
    block: int = 0
    """How many of them each root seed, policy or round has for itself; 0: all share one block, the whole range."""

    @property
    def blocks(self) -> int:
        return (self.stop - self.first) // self.block if self.block else 1

    def take(self, count: int, block: int = 0) -> int:
        """Return the first of `count` seeds in a row of block number `block`.

        Raises:
            ValueError: the block does not hold as many, or there is no such block.
        """
        if not 0 <= block < self.blocks:
            raise ValueError(f"{self.purpose} have {self.blocks} blocks of reset seeds, and number {block} was asked "
                             f"for; change {self.settings}")
        first = self.first + block * self.block
        replace(self, first=first, stop=first + self.block if self.block else self.stop).check(first, count)
        return first

    def check(self, first: int, count: int) -> None:
        """Raise ValueError unless `count` seeds from `first` on lie within the range."""
        if not (self.first <= first and first + count <= self.stop):
            raise ValueError(
                f"{count} {self.purpose} from reset seed {first} on do not lie within {self.first} to {self.stop - 1}, "
                f"the seeds kept for them; change {self.settings}"
            )


MODEL_EPISODES = SeedRange("episodes that models learn from", 0, 250_000, "data.num_episodes, --episodes or --seed")
NEW_CONTEXTS = SeedRange("contexts that no shipped model has seen", 250_000, 300_000, "the number of contexts")
WEAK_DEMONSTRATIONS = SeedRange("demonstrations for weak policies", 300_000, 310_000, "the task's weak_policies", 1000)
WEAK_POLICIES = SeedRange("episodes of weak policies", 310_000, 500_000, "data.policy_episodes", 10_000)
HELDOUT = SeedRange("held-out episodes", 500_000, 600_000, "data.num_heldout")
DEMONSTRATIONS = SeedRange("demonstrations", 600_000, 700_000, "sft.num_demonstrations", 1000)
STARTS = SeedRange("first frames to imagine from", 700_000, 800_000, "evaluation.episodes")
ROUNDS = SeedRange("episodes of a round", 800_000, 900_000, "model_refresh.episodes_per_round", 5000)
HELDOUT_ROUNDS = SeedRange("held-out episodes of a round", 900_000, 1_000_000, "model_refresh.heldout_episodes", 5000)
EVALUATION = SeedRange(
    "evaluation episodes", 1_000_000, 2_000_000, "evaluation.first_seed or evaluation.episodes"
)
MORE_DEMONSTRATIONS = SeedRange("demonstrations", 2_000_000, 2**31, "sft.num_demonstrations", 1000)
"""Of the root seeds that have no block of DEMONSTRATIONS, or too little behind it."""
UNSEEDED = SeedRange("resets without a seed", 2**31, 2**32, "")
"""2^32 is where the simulator's seeds end: it takes larger ones modulo that."""
RANGES = (
    MODEL_EPISODES, NEW_CONTEXTS, WEAK_DEMONSTRATIONS, WEAK_POLICIES, HELDOUT, DEMONSTRATIONS, STARTS, ROUNDS,
    HELDOUT_ROUNDS, EVALUATION, MORE_DEMONSTRATIONS, UNSEEDED,
)


def demonstration_seeds(root_seed: int, count: int) -> int:
    """Return the first reset seed of a run's `count` demonstrations. Raises ValueError as SeedRange.check.

    Those that a block does not hold are also demonstrations of other root seeds, mostly of those after this one.
    """
    kept, block = DEMONSTRATIONS, root_seed
    if root_seed >= kept.blocks:
        kept, block = MORE_DEMONSTRATIONS, (root_seed - kept.blocks) % MORE_DEMONSTRATIONS.blocks
    elif kept.first + block * kept.block + count > kept.stop:
        kept = MORE_DEMONSTRATIONS
    first = kept.first + block * kept.block
    kept.check(first, count)
    return first


def seed_spans(seeds: Iterable[int]) -> list[list[int]]:
    """Return the different seeds as [first, last] of every run of them without a gap, ascending."""
    spans = list[list[int]]()
    for seed in sorted({int(seed) for seed in seeds}):
        if spans and seed == spans[-1][1] + 1:
            spans[-1][1] = seed
        else:
            spans.append([seed, seed])
    return spans
