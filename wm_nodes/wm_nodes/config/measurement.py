"""What the settings of loop 1 mean that say how models and policies are measured; schema.py has the others."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from wm_nodes.config.environments import ScenesName
from wm_nodes.config.sections import (
    EnvironmentName,
    Fraction,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    SettingsSection,
)
from wm_nodes.config.seed_ranges import EVALUATION


class ExploitMeterConfig(SettingsSection):
    """How often the training asks the simulator whether what the model calls success is one; see
    policy_rl/validation/exploit_meter.py."""

    every: NonNegativeInt
    """Policy updates from one reading to the next; the first is of the policy that training begins with. 0: off."""
    episodes: PositiveInt
    """Of a reading, each from another first frame; always the same ones."""
    stop_precision: Fraction
    """Training stops where even the upper end of the precision's 95 % interval is below it; 0: never."""


class AcceptanceConfig(SettingsSection):
    num_episodes: PositiveInt
    """Held-out real episodes that acceptance is measured on."""
    object_error_ratio: PositiveFloat
    """Full-horizon object error must be below this share of the error of copying the first frame."""
    tool_error_ratio: PositiveFloat
    """The same of the tool's error."""
    feature_error_ratio: PositiveFloat = 1.0
    """Without ground truth: the distance of imagined to recorded pictures, by the tokenizer's features, must be below
    this share of that of the first frame."""
    other_actions_ratio: PositiveFloat = 1.0
    """The same distance under another episode's actions must be at least so many times that under the recorded ones."""
    varying_error_ratio: PositiveFloat = 1.0
    """Of encoded and decoded frames: nine tenths of the pixels that vary between episodes at one step must have a
    squared error below this share of their variance, at every step."""
    done_precision: Fraction
    """Least precision of the done signal."""
    done_recall: Fraction
    """On rollouts of held-out actions, not on real frames, and on rollouts of the cloned policy."""
    clone_episodes: NonNegativeInt = 0
    """Held-out first frames from which the cloned policy is rolled out, its actions then replayed in the simulator; 0:
    none."""
    clone_scenes: list[ScenesName] = Field(default=[])
    """Further scenes of a task that has many, each a value of simulation.scenes, of which as many first frames are
    taken: the done signal must be right there, too."""
    goal_error_ratio: PositiveFloat = 1.0
    """Where goals are rewards: errors of imagined goals must be below this share of those of the first frame."""
    success_margin: PositiveFloat = 1.0
    """The cloned policy's imagined success must lie within this of its real success, with the whole 95 % interval."""
    require_success_agreement: bool
    """Whether that is asked for."""


class ModelRefreshConfig(SettingsSection):
    """Online rounds: train in the model, collect with the policy in the simulator, refresh the model, go on."""

    num_rounds: Annotated[int, Field(ge=1, le=20)]
    """1: off. ppo.updates are split over the rounds."""
    episodes_per_round: Annotated[int, Field(ge=1, le=5000)]
    """Simulator episodes of the round's policy that the model is refreshed on."""
    heldout_episodes: Annotated[int, Field(ge=1, le=5000)]
    """Further ones, never trained on, on which the new model is compared with the old one."""
    replay_episodes: PositiveInt
    """Scripted simulator episodes mixed into every refresh, against forgetting."""
    refresh_iterations: PositiveInt
    """Of a refresh."""
    learning_rate: PositiveFloat
    """Peak learning rate of a refresh."""
    own_starts: Annotated[int, Field(ge=0, le=5000)]
    """Frames of the policy's own episodes, before success, to imagine from after a refresh, beside the first frames."""


class EvaluationConfig(SettingsSection):
    environment: EnvironmentName
    """What the policy is measured in, said as environment.factory; none: only what is imagined is measured."""
    episodes: PositiveInt
    """Per evaluation."""
    first_seed: NonNegativeInt
    """Reset seed of the first evaluation episode; all lie in the range of evaluations, see config/seed_ranges.py."""
    deterministic: bool
    """The mean action, without exploration noise."""

    @model_validator(mode="after")
    def _check_seeds(self) -> Self:
        EVALUATION.check(self.first_seed, self.episodes)
        return self
