"""From a folder to everything that GRPO needs of a public model."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from wm_nodes.core.device import device_of
from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.video_model.adapters.codec import VideoCodec
from wm_nodes.video_model.adapters.cosmos import CosmosVelocity
from wm_nodes.video_model.adapters.folder import ModelFolder
from wm_nodes.video_model.adapters.packages import package
from wm_nodes.video_model.adapters.text import MAX_TOKENS, TextEncoder
from wm_nodes.video_model.adapters.velocity import PublicVelocity
from wm_nodes.video_model.adapters.wan import WanVelocity
from wm_nodes.video_model.conditions import Condition

Precision = Literal["float32", "bfloat16", "float16"]
WAN = ("WanPipeline", "WanImageToVideoPipeline")
COSMOS = "Cosmos2_5_PredictBasePipeline"


@dataclass(frozen=True)
class LoadSettings:
    """How a public model is loaded."""

    dtype: Precision = "float32"
    """Of the weights of network and text encoder; the VAE's are float32, since its pictures suffer from less."""
    device: str = "cpu"
    """Where everything computes."""
    offload: bool = False
    """VAE and text encoder rest on the CPU and visit the device."""
    gradient_checkpointing: bool = False
    """Trade a second forward pass for the activations' memory."""
    max_tokens: int = MAX_TOKENS
    """Of an embedded prompt."""
    negative_prompt: str = ""
    """What the unconditional branch sees."""


@dataclass(frozen=True)
class PublicVideoModel:
    """Everything that GRPO needs of a public model."""

    velocity: PublicVelocity
    """The network, trainable."""
    codec: VideoCodec
    """Camera frames to latents and back."""
    text: TextEncoder
    """Of prompts."""
    shift: float
    """RolloutConfig.shift of the model's own scheduler."""

    def condition(self, frames: Tensor, prompts: list[str], latent_frames: int) -> Condition:
        """Return what videos of `latent_frames` latent frames are made from, without actions, where the network is.

        The text is projected once where the network has a frozen projection of it (see CosmosVelocity.project_text).

        Args:
            frames: given camera frames, uint8 (B, N, H, W, 3). prompts: one each.

        Raises:
            ValueError: as VideoCodec.encode.
        """
        device = device_of(self.velocity)
        text = torch.cat([self.velocity.project_text(self.text.encode([p]).to(device)).float() for p in prompts])
        actions = torch.zeros(len(frames), latent_frames - 1, 0)
        return Condition(self.codec.encode(frames), actions, text).to(device)


def load_public_model(folder: Path | str, settings: LoadSettings | None = None) -> PublicVideoModel:
    """Load a Wan or Cosmos-Predict2.5 folder; nothing is fetched and nothing in it is executed.

    Raises:
        ModelFolderError: the folder is missing, incomplete or of another kind; names the path and the remedy.
        MissingPackageError: a package of requirements/video.txt is not installed.
    """
    settings = settings or LoadSettings()
    package("diffusers"), package("transformers")
    files = ModelFolder(folder)
    if files.pipeline not in (*WAN, COSMOS):
        raise ModelFolderError(f"{files.folder} holds a {files.pipeline}; supported are {', '.join((*WAN, COSMOS))}")
    if files.has("transformer_2"):
        raise ModelFolderError(
            f"{files.folder} holds two experts (Wan 2.2 A14B), which are not supported; take Wan 2.1 or Wan 2.2 TI2V-5B"
        )
    dtype = getattr(torch, settings.dtype)
    vae = files.model("vae", "AutoencoderKLWan", torch.float32)
    codec = VideoCodec(vae, device=settings.device, offload=settings.offload)
    text = TextEncoder(
        files.text_encoder(dtype), files.tokenizer(), "cosmos2.5" if files.pipeline == COSMOS else "wan",
        device=settings.device, offload=settings.offload, max_tokens=settings.max_tokens,
    )
    null_text = text.encode([settings.negative_prompt])[0]
    scheduler = files.scheduler()
    try:
        velocity: PublicVelocity
        if files.pipeline == COSMOS:
            velocity = CosmosVelocity(files.model("transformer", "CosmosTransformer3DModel", dtype), null_text)
        else:
            velocity = WanVelocity(
                files.model("transformer", "WanTransformer3DModel", dtype), null_text,
                fused=bool(files.index.get("expand_timesteps")),
                time_scale=float(scheduler.get("num_train_timesteps", 1000)),
            )
    except ModelFolderError:
        raise
    except ValueError as error:
        raise ModelFolderError(f"{files.folder / 'transformer'}: {error}") from error
    velocity.to(settings.device)
    if settings.gradient_checkpointing:
        velocity.enable_gradient_checkpointing()
    return PublicVideoModel(velocity, codec, text, _shift(scheduler))


def _shift(scheduler: dict[str, Any]) -> float:
    """Wan's schedulers state it; Cosmos's sigmas are Karras's, for which we take 5."""
    if scheduler.get("use_karras_sigmas"):
        return 5.0
    shift: float = scheduler.get("flow_shift", scheduler.get("shift", 1.0))
    return float(shift)
