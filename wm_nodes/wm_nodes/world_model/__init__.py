"""World models that stand in for the simulator: frame codec, next-frame models, goals, imagined environment."""

from wm_nodes.world_model.dynamics import ActionModel
from wm_nodes.world_model.folder import WorldModels, load_model_folder, save_model_folder, save_refreshed_folder
from wm_nodes.world_model.imagined_environment import DeviceEnvironment, ImaginedEnvironment
from wm_nodes.world_model.imagined_episodes import ImaginedEpisodes
from wm_nodes.world_model.starts import load_start_instructions, load_starts
from wm_nodes.world_model.text import TextModel, imagine_goals
from wm_nodes.world_model.tokenizer import Tokenizer

__all__ = [
    "ActionModel", "DeviceEnvironment", "ImaginedEnvironment", "ImaginedEpisodes", "TextModel", "Tokenizer",
    "WorldModels", "imagine_goals", "load_model_folder", "load_start_instructions", "load_starts", "save_model_folder",
    "save_refreshed_folder",
]
