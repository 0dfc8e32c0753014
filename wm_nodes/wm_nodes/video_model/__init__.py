"""A flow-matching video model, its stochastic samplers, and what GRPO stores of them. DD-3 to DD-12."""

from wm_nodes.video_model.buffer import RolloutBuffer, RolloutBufferError, config_hash
from wm_nodes.video_model.conditions import Condition
from wm_nodes.video_model.kernels import StepContext, step
from wm_nodes.video_model.network import NetworkSettings, VideoNetwork, guided_velocity
from wm_nodes.video_model.sampling import VideoRollout, initial_noise, sample_videos
from wm_nodes.video_model.schedule import flow_times, select_steps, stochastic_steps

__all__ = [
    "Condition", "NetworkSettings", "RolloutBuffer", "RolloutBufferError", "StepContext", "VideoNetwork",
    "VideoRollout", "config_hash", "flow_times", "guided_velocity", "initial_noise", "sample_videos", "select_steps",
    "step", "stochastic_steps",
]
