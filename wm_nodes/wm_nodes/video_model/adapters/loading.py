"""From a local folder of the diffusers layout to everything that GRPO needs of a public model: safetensors only, no
network, no code from the folder. Shapes: B batch, N camera frames, H W 3 image, L tokens of E values."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from wm_nodes.core.device import device_of
from wm_nodes.core.model_folder import ModelFolderError, read_json
from wm_nodes.video_model.adapters.codec import VideoCodec
from wm_nodes.video_model.adapters.cosmos import CosmosVelocity
from wm_nodes.video_model.adapters.velocity import PublicVelocity, package
from wm_nodes.video_model.adapters.wan import TIME_SCALE, WanVelocity
from wm_nodes.video_model.conditions import Condition

WAN, COSMOS = ("WanPipeline", "WanImageToVideoPipeline"), "Cosmos2_5_PredictBasePipeline"
MAX_TOKENS = 512
"""Of an embedded prompt with its padding, to which the models attend."""
REMEDY = "download the whole model again in its diffusers layout (with safetensors), and name that folder"


@dataclass(frozen=True)
class PublicVideoModel:
    """Everything that GRPO needs of a public model."""

    velocity: PublicVelocity
    """The network, trainable."""
    codec: VideoCodec
    """Camera frames to latents and back."""
    pipeline: Any
    """Of diffusers, with tokenizer and text encoder; see embed_prompts."""
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
        texts = (embed_prompts(self.pipeline, [prompt]).to(device) for prompt in prompts)
        text = torch.cat([self.velocity.project_text(text).float() for text in texts])
        actions = torch.zeros(len(frames), latent_frames - 1, 0)
        return Condition(self.codec.encode(frames), actions, text).to(device)


def load_public_model(
    folder: Path | str, *, dtype: str = "float32", device: str = "cpu", gradient_checkpointing: bool = False,
    negative_prompt: str = "",
) -> PublicVideoModel:
    """Load a Wan or Cosmos-Predict2.5 folder.

    Args:
        dtype: of the weights of network and text encoder; the VAE's are float32, since its pictures suffer from less.
        device: where everything computes.
        gradient_checkpointing: trade a second forward pass for the activations' memory.
        negative_prompt: what the unconditional branch sees.

    Raises:
        ModelFolderError: the folder is missing, incomplete or of another kind; names the path and the remedy.
        MissingPackageError: a package of requirements/video.txt is not installed.
    """
    diffusers, transformers, _ = map(package, ("diffusers", "transformers", "ftfy"))
    folder = Path(folder)
    index = read_json(folder / "model_index.json", REMEDY)
    scheduler = read_json(folder / "scheduler" / "scheduler_config.json", REMEDY)
    kind = index.get("_class_name")
    if kind not in (*WAN, COSMOS):
        raise ModelFolderError(f"{folder} holds a {kind}; supported are {', '.join((*WAN, COSMOS))}")
    if index.get("transformer_2", [None])[-1] is not None:
        raise ModelFolderError(
            f"{folder} holds two experts (Wan 2.2 A14B), which are not supported; take Wan 2.1 or Wan 2.2 TI2V-5B"
        )
    if kind in WAN and (steps := scheduler.get("num_train_timesteps", TIME_SCALE)) != TIME_SCALE:
        raise ModelFolderError(
            f"{folder / 'scheduler'} has num_train_timesteps {steps}; Wan is supported with {TIME_SCALE}"
        )
    encoder, network = transformers.UMT5EncoderModel, diffusers.WanTransformer3DModel
    if kind == COSMOS:
        encoder, network = transformers.Qwen2_5_VLForConditionalGeneration, diffusers.CosmosTransformer3DModel
    weights = getattr(torch, dtype)
    vae = _load(diffusers.AutoencoderKLWan, folder / "vae", torch.float32)
    pipeline = getattr(diffusers, kind)(
        tokenizer=_read(transformers.AutoTokenizer, folder / "tokenizer", trust_remote_code=False),
        text_encoder=_load(encoder, folder / "text_encoder", weights).requires_grad_(False).to(device), vae=vae,
        scheduler=None, transformer=None,
        **({"safety_checker": nn.Identity()} if kind == COSMOS else {}),
    )
    transformer = _load(network, folder / "transformer", weights)
    null_text = embed_prompts(pipeline, [negative_prompt])[0]
    try:
        velocity = CosmosVelocity(transformer, null_text) if kind == COSMOS else WanVelocity(
            transformer, null_text, fused=bool(index.get("expand_timesteps"))
        )
    except ValueError as error:
        raise ModelFolderError(f"{folder / 'transformer'}: {error}") from error
    if gradient_checkpointing:
        transformer.enable_gradient_checkpointing()
    # Wan's schedulers state the shift; Cosmos's sigmas are Karras's, for which we take 5
    shift = 5.0 if scheduler.get("use_karras_sigmas") else scheduler.get("flow_shift", scheduler.get("shift", 1.0))
    return PublicVideoModel(velocity.to(device), VideoCodec(vae, device=device), pipeline, float(shift))


@torch.no_grad()
def embed_prompts(pipeline: Any, prompts: list[str]) -> Tensor:
    """Return what a diffusers pipeline makes of prompts, padded to MAX_TOKENS, (B, L, E) where its text encoder is."""
    text: Tensor = pipeline.encode_prompt(
        prompts, do_classifier_free_guidance=False, max_sequence_length=MAX_TOKENS, device=pipeline.text_encoder.device
    )[0]
    return text


def _load(kind: Any, path: Path, dtype: torch.dtype) -> Any:
    """A part with every weight from its folder, in evaluation mode."""
    model, report = _read(kind, path, torch_dtype=dtype, use_safetensors=True, output_loading_info=True)
    absent = sorted(str(name) for name in report["missing_keys"])
    if absent:
        raise ModelFolderError(
            f"{path} lacks {len(absent)} weights of its {kind.__name__}, the first {absent[0]}; {REMEDY}"
        )
    return model.eval()


def _read(kind: Any, path: Path, **options: Any) -> Any:
    try:
        return kind.from_pretrained(str(path), local_files_only=True, **options)
    except Exception as error:  # torch, safetensors and both libraries raise kinds of their own
        raise ModelFolderError(
            f"{path} cannot be loaded as {kind.__name__} ({type(error).__name__}: {error}); {REMEDY}"
        ) from error
