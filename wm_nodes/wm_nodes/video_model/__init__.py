"""A flow-matching video model, its stochastic samplers, and what GRPO stores of them. DD-3 to DD-12."""

from wm_nodes.video_model.buffer import RolloutBuffer, RolloutBufferError, config_hash
from wm_nodes.video_model.conditions import Condition
from wm_nodes.video_model.kernels import Step, StepContext, estimates, step
from wm_nodes.video_model.mask import dynamic_mask
from wm_nodes.video_model.network import NetworkSettings, VelocityModel, VideoNetwork, guided_velocity
from wm_nodes.video_model.sampling import VideoRollout, initial_noise, sample_videos, step_noise
from wm_nodes.video_model.schedule import flow_times, select_steps, stochastic_steps

__all__ = [
    "Condition", "NetworkSettings", "RolloutBuffer", "RolloutBufferError", "Step",
    "StepContext", "VelocityModel", "VideoNetwork", "VideoRollout",
    "config_hash", "dynamic_mask", "estimates", "flow_times", "guided_velocity", "initial_noise",
    "sample_videos", "select_steps", "step", "step_noise", "stochastic_steps",
]
