"""Public video diffusion models behind VelocityModel. The packages they need are optional; see requirements/video.txt.

Supported, as diffusers folders: Wan 2.1 text to video, Wan 2.2 TI2V-5B (clean first frames in place), Cosmos-Predict2.5
base models.
Not supported: Wan's I2V models and Wan 2.2 A14B, whose two experts share the times.
Nor Kairos-3.0-Robot as published. Its path, velocity, VAE (Wan 2.1) and way to give first frames (clean
latents with a time of their own, WanVelocity with fused) are Wan's, but its network (KairosDiT: gated linear
attention in every fourth block, dilated local attention in the others) is in no diffusers release and its weights are
in no diffusers folder. WanVelocity takes any module with the call of WanTransformer3DModel, so a wrapper around the
published network is all that is missing, beside its text encoder (last hidden states of Qwen2.5-VL).
"""

from wm_nodes.video_model.adapters.codec import VideoCodec
from wm_nodes.video_model.adapters.cosmos import CosmosVelocity
from wm_nodes.video_model.adapters.loading import PublicVideoModel, load_public_model
from wm_nodes.video_model.adapters.velocity import PublicVelocity, add_lora, save_lora
from wm_nodes.video_model.adapters.wan import WanVelocity

__all__ = [
    "CosmosVelocity", "PublicVelocity", "PublicVideoModel", "VideoCodec", "WanVelocity", "add_lora",
    "load_public_model", "save_lora",
]
