"""Where the values of simulation.object_state come from: the truth while a world model is made, then its reader."""

from pathlib import Path

from wm_nodes.config.environments import TRUTH
from wm_nodes.config.schema import RunConfig

READER = "object_reader.safetensors"
"""In a world model's folder."""


def with_truth(config: RunConfig) -> RunConfig:
    """The configuration of recordings that a reader is trained on, where one is: their states say the truth."""
    if not config.world_model.object_reader_iterations:
        return config
    return config.with_values(simulation=config.simulation.with_values(object_state=TRUTH))


def is_read(config: RunConfig) -> bool:
    """Whether a reader fills simulation.object_state."""
    return config.simulation.object_state not in ("", TRUTH)


def of_demonstrations(config: RunConfig) -> RunConfig:
    """The configuration that demonstrations are recorded with, see sft.state_noise_m."""
    if not (config.sft.state_noise_m and is_read(config)):
        return config
    return config.with_values(simulation=config.simulation.with_values(object_state=TRUTH))


def with_reader(config: RunConfig, model_dir: Path | None) -> RunConfig:
    """The configuration whose states say what the reader of the model's folder sees, where the folder has one and the
    settings name nothing else."""
    if config.simulation.object_state or model_dir is None or not (model_dir / READER).is_file():
        return config
    return config.with_values(simulation=config.simulation.with_values(object_state=str(model_dir / READER)))
