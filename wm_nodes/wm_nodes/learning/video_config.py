"""Settings of loop 2, the post-training of the video model. The numbers are those of the presets and of the dataclasses
that own them; here they are put together, read and checked."""

import dataclasses
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from wm_nodes.config.load import ConfigError
from wm_nodes.learning.video_grpo import GrpoSettings
from wm_nodes.learning.video_training import FlowMatchingSettings
from wm_nodes.video_model import RolloutSettings, WindowSettings

PRESETS = "video_presets"


@dataclass(frozen=True)
class ModelSettings:
    """The embedded model. patch, channels: of the codec. stride: recorded steps between frames. num_conditioning: given
    frames. text_dim: values per hashed word. width, depth: of the network. batch_size: clips per training step.
    """

    patch: int = 4
    channels: int = 16
    stride: int = 2
    num_conditioning: int = 1
    text_dim: int = 16
    width: int = 64
    depth: int = 5
    batch_size: int = 8
    training: FlowMatchingSettings = field(default_factory=lambda: FlowMatchingSettings(3000))


@dataclass(frozen=True)
class GroupSettings:
    """contexts: per iteration; group_size: videos of each. shared_noise: one initial noise for a whole group."""

    contexts: int = 4
    group_size: int = 8
    shared_noise: bool = False


@dataclass(frozen=True)
class EvaluationSettings:
    """Held-out contexts, sampled by ODE before and after. num_steps: sampler steps."""

    contexts: int = 48
    num_steps: int = 10


@dataclass(frozen=True)
class VideoRlConfig:
    """Everything of a run of loop 2. rewards: weight of each reward; see clip_scores and the evaluator's backends."""

    seed: int = 0
    task: str = "push_cube"
    iterations: int = 30
    data_episodes: int = 1000
    rewards: dict[str, float] = field(default_factory=lambda: {"tracking": 1.0, "scenery": -5.0})
    model: ModelSettings = field(default_factory=ModelSettings)
    groups: GroupSettings = field(default_factory=GroupSettings)
    evaluation: EvaluationSettings = field(default_factory=EvaluationSettings)
    window: WindowSettings = field(default_factory=WindowSettings)
    rollout: RolloutSettings = field(default_factory=RolloutSettings)
    grpo: GrpoSettings = field(default_factory=GrpoSettings)


def video_preset_names() -> list[str]:
    folder = resources.files("wm_nodes.config") / PRESETS
    return sorted(Path(entry.name).stem for entry in folder.iterdir() if entry.name.endswith(".yaml"))


def load_video_config(preset: str = "recommended", overrides: dict[str, Any] | None = None) -> VideoRlConfig:
    """Return the resolved settings: defaults, then the preset (a name or a .yaml file), then dotted overrides.

    Raises:
        ConfigError: names the value, what is allowed, and where to look.
    """
    values = dataclasses.asdict(VideoRlConfig())
    _merge(values, _read(preset), "")
    for dotted, value in (overrides or {}).items():
        nested: Any = value
        for name in reversed(dotted.split(".")):
            nested = {name: nested}
        _merge(values, nested, "")
    return _build(values)


def dump_video_config(config: VideoRlConfig) -> str:
    """The resolved settings as YAML, as saved with every run; load_video_config reads it back."""
    return str(yaml.safe_dump(dataclasses.asdict(config), sort_keys=False))


def _build(values: dict[str, Any]) -> VideoRlConfig:
    try:
        config: VideoRlConfig = TypeAdapter(VideoRlConfig).validate_python(values)
    except ValidationError as error:
        lines = [f"  {'.'.join(map(str, e['loc']))}: {e['msg']} (got {e['input']!r})" for e in error.errors()]
        raise ConfigError("settings refused; see learning/video_config.py:\n" + "\n".join(lines)) from None
    return config


def _read(preset: str) -> dict[str, Any]:
    if preset in video_preset_names():
        text = (resources.files("wm_nodes.config") / PRESETS / f"{preset}.yaml").read_text()
    elif Path(preset).suffix in {".yaml", ".yml"} and Path(preset).is_file():
        text = Path(preset).read_text()
    else:
        names = ", ".join(video_preset_names())
        raise ConfigError(f"unknown preset {preset!r}; choose one of {names} or give a .yaml file")
    values = yaml.safe_load(text) or {}
    if not isinstance(values, dict):
        raise ConfigError(f"preset {preset!r} must be a YAML mapping")
    return values


def _merge(base: dict[str, Any], top: dict[str, Any], path: str) -> None:
    for key, value in top.items():
        if key not in base:
            raise ConfigError(f"unknown setting {path + key!r}; known there: {', '.join(base)}")
        if isinstance(value, dict) and isinstance(base[key], dict) and key != "rewards":
            _merge(base[key], value, f"{path}{key}.")
        else:
            base[key] = value
