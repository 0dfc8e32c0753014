"""Settings of GRPO of a video model; the numbers are those of DynDiff-GRPO's Table 5 where it gives them."""

from dataclasses import dataclass, field
from typing import Literal

from wm_nodes.video_model.transitions import MaskSource
from wm_nodes.video_rl.group_advantages import StdScope
from wm_nodes.video_rl.grpo_math import KlMode, LogprobWeight

Trains = Literal["all", "condition"]
Anchor = Literal["buffer", "frozen", "lora_off", "moving", "dual"]


@dataclass(frozen=True)
class AdvantageSettings:
    """DD-13. clip: of the normalised advantage. mix: several rewards are added before they are normalised (reward), or
    each is normalised and then weighed (advantage). std_scope: which standard deviation normalises, see
    group_advantages; flow_grpo's global_std is batch, not global. best_of_n: videos of a group that train, best and
    worst; 0: all. floor: a group with std < floor max(1, |mean|) has no spread. source: what is normalised, the reward,
    or (win_rate) Pref-GRPO's share of wins against the others of the group.
    """

    clip: float = 2.5
    mix: Literal["reward", "advantage"] = "reward"
    std_scope: StdScope = "group"
    ddof: int = 0
    best_of_n: int = 0
    floor: float = 1e-6
    source: Literal["reward", "win_rate"] = "reward"


@dataclass(frozen=True)
class KlSettings:
    """DD-17, DD-20. beta: weight. anchor: buffer (what sampled), frozen (the model as it was at the start), lora_off
    (the same through switching the adapter off), moving (weights of every `moving_updates`-th update), dual (buffer
    always, frozen on every `dual_every`-th update beside it).
    """

    mode: KlMode = "mean"
    beta: float = 0.5
    anchor: Anchor = "buffer"
    moving_updates: int = 10
    dual_every: int = 4


@dataclass(frozen=True)
class GrpoSettings:
    """Everything of the update; lengths and limits as in DynDiff-GRPO's Table 5 where it gives them.

    trains: every parameter that asks for a gradient, or (condition) those of VideoNetwork.condition_parameters alone.
    updates_per_buffer: N_KL, optimizer steps on one buffer; passes: each on the whole buffer (full), or on its own
    part of the videos (parts). step_fraction, step_select, min_s: see step_window.select_steps. cfg: guidance of the
    training pass. ratio_norm: DD-15b. equalise: weigh steps by SAGE's equaliser. max_staleness: optimizer steps between
    sampling and training that are still accepted.

    Raises:
        ValueError: two of logprob_weight, mask_source and ratio_norm are set; each says what the ratio is.
    """

    advantage: AdvantageSettings = field(default_factory=AdvantageSettings)
    kl: KlSettings = field(default_factory=KlSettings)
    trains: Trains = "all"
    clip_low: float = 1e-4
    clip_high: float = 1e-4
    logprob_weight: LogprobWeight = "full"
    mask_source: MaskSource = "cached"
    ratio_norm: bool = False
    equalise: bool = False
    updates_per_buffer: int = 2
    passes: Literal["full", "parts"] = "full"
    step_fraction: float = 0.55
    step_select: Literal["random", "first", "tmin"] = "random"
    min_s: float = 0.02
    cfg: float = 1.0
    micro_batch: int = 32
    learning_rate: float = 2e-6
    weight_decay: float = 0.01
    max_grad_norm: float = 1.0
    ema_decay: float = 0.0
    max_staleness: int = 0

    def __post_init__(self) -> None:
        others = {"logprob_weight": self.logprob_weight != "full", "ratio_norm": self.ratio_norm}
        if self.mask_source == "recompute" and any(others.values()):
            given = ", ".join(f"{name} {getattr(self, name)}" for name, other in others.items() if other)
            raise ValueError(
                f"mask_source recompute has the full likelihood (DD-12), got {given}; take logprob_weight full and "
                "ratio_norm false, or mask_source cached"
            )
        if all(others.values()):
            raise ValueError(
                f"ratio_norm replaces the weight of the likelihood, got logprob_weight {self.logprob_weight}; take full"
            )
