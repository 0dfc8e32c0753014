"""Settings of loop 2, the post-training of the video model. The numbers are those of the presets and of the dataclasses
that own them; here they are put together, read and checked."""

from dataclasses import dataclass, field
from typing import Any, Literal

import yaml
from pydantic import TypeAdapter, ValidationError

from wm_nodes.config.load import default_judge, merge, preset_names, read_preset, refusal, set_dotted
from wm_nodes.config.schema import AGENT, JudgeConfig
from wm_nodes.video_model import RolloutSettings, WindowSettings
from wm_nodes.video_model.flow_matching import FlowMatchingSettings
from wm_nodes.video_rl.grpo_settings import GrpoSettings

PRESETS = "video_presets"
FREE = ("rewards",)


@dataclass(frozen=True)
class ModelSettings:
    """The embedded model. codec: principal components of patches (patch: its side, channels: how many), or the frozen
    tokenizer of the task's shipped world model. stride: recorded steps between frames. num_conditioning: given frames.
    text_dim: values per hashed word. width, depth: of the network. batch_size: clips per training step.
    """

    codec: Literal["patch", "tokenizer"] = "tokenizer"
    patch: int = 4
    channels: int = 16
    stride: int = 2
    num_conditioning: int = 1
    text_dim: int = 16
    width: int = 128
    depth: int = 5
    batch_size: int = 16
    training: FlowMatchingSettings = field(default_factory=lambda: FlowMatchingSettings(4000))


@dataclass(frozen=True)
class GroupSettings:
    """contexts: per iteration; group_size: videos of each. shared_noise: one initial noise for a whole group."""

    contexts: int = 4
    group_size: int = 8
    shared_noise: bool = False


@dataclass(frozen=True)
class EvaluationSettings:
    """Held-out contexts, one ODE clip each, before, during and after. num_steps: sampler steps. every: buffers between
    two evaluations of the learner; 0: none. window: newest evaluations over which DD-2 compares the training
    reward with the held-out scores; at least 3.
    """

    contexts: int = 48
    num_steps: int = 10
    every: int = 5
    window: int = 4

    def __post_init__(self) -> None:
        if self.contexts < 1 or self.num_steps < 1 or self.every < 0 or self.window < 3:
            raise ValueError(
                "evaluation needs contexts >= 1, num_steps >= 1, every >= 0 (0: never) and window >= 3, got "
                f"{self.contexts}, {self.num_steps}, {self.every} and {self.window}"
            )


@dataclass(frozen=True)
class VideoRlConfig:
    """Everything of a run of loop 2. data_episodes: of the simulator, to train the video model on and to draw contexts
    from; context_episodes: those of a run whose video model is the shipped one. rewards: weight of each reward; see
    clip_scores, and AGENT for the reward agent, which needs a judge.
    """

    seed: int = 0
    task: str = "push_cube"
    iterations: int = 30
    data_episodes: int = 1000
    context_episodes: int = 200
    rewards: dict[str, float] = field(default_factory=lambda: {"tracking": 1.0, "scenery": -5.0})
    judge: JudgeConfig = field(default_factory=default_judge)
    model: ModelSettings = field(default_factory=ModelSettings)
    groups: GroupSettings = field(default_factory=GroupSettings)
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    window: WindowSettings = field(default_factory=WindowSettings)
    rollout: RolloutSettings = field(default_factory=RolloutSettings)
    grpo: GrpoSettings = field(default_factory=GrpoSettings)


_CONFIG = TypeAdapter(VideoRlConfig)


def video_preset_names() -> list[str]:
    return preset_names(PRESETS)


def load_video_config(preset: str = "recommended", overrides: dict[str, Any] | None = None) -> VideoRlConfig:
    """Return the resolved settings: defaults, then the preset (a name or a .yaml file), then dotted overrides.

    Raises:
        ConfigError: names the value, what is allowed, and where to look.
    """
    values = _CONFIG.dump_python(VideoRlConfig())
    merge(values, read_preset(preset, PRESETS), FREE)
    for dotted, value in (overrides or {}).items():
        set_dotted(values, dotted, value, FREE)
    try:
        return _CONFIG.validate_python(values)
    except ValidationError as error:
        raise refusal(error, "video_rl/settings.py") from None


REWARDS = ("reference", AGENT)


def reward_overrides(reward: str | None) -> dict[str, Any]:
    """The setting that a user's word for the reward stands for: the weights of the rewards; None: none."""
    if reward is None:
        return {}
    return {"rewards": {AGENT: 1.0} if reward == AGENT else VideoRlConfig().rewards}


def dump_video_config(config: VideoRlConfig) -> str:
    """The resolved settings as YAML, as saved with every run; load_video_config reads it back."""
    return str(yaml.safe_dump(_CONFIG.dump_python(config), sort_keys=False))
