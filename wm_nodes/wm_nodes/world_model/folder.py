"""World models on disk: one folder with safetensors files and a manifest that says how they were made."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import nn

from wm_nodes.config.object_state import READER
from wm_nodes.config.schema import RunConfig, TokenizerConfig, WorldModelConfig
from wm_nodes.core.model_folder import (
    ModelFolderError,
    files_sha256,
    read_manifest,
    read_model_file,
    write_model_folder,
)
from wm_nodes.core.specs import EnvironmentSpec, spec_of_values, spec_values, tool_spec
from wm_nodes.training.weights import WeightsError, check_same_layout, pack_weights
from wm_nodes.world_model.dynamics import ActionModel
from wm_nodes.world_model.position_probe import PositionProbe
from wm_nodes.world_model.positions import num_positions_of
from wm_nodes.world_model.sentence_encoder import SentenceCondition
from wm_nodes.world_model.state_model import state_sizes
from wm_nodes.world_model.text import TextModel
from wm_nodes.world_model.token_dynamics import TokenActionModel
from wm_nodes.world_model.tokenizer import Tokenizer

FILES = {
    "tokenizer": "tokenizer.safetensors",
    "decoder": "decoder.safetensors",
    "action": "action_model.safetensors",
    "text": "text_model.safetensors",
    "probe": "position_probe.safetensors",
    "reader": READER,
}
FORMAT = 2


@dataclass(frozen=True)
class WorldModels:
    """The networks of a world-model folder, and what they were trained on."""

    tokenizer: Tokenizer
    """With the decoder of rollouts, where the folder has one."""
    action: ActionModel | TokenActionModel
    """Of tokens where the tokenizer is lfq, else of continuous latents."""
    text: TextModel | None
    """None where no text model was trained."""
    tasks: tuple[str, ...]
    """The done head's outputs, in order."""
    spec: EnvironmentSpec
    """Of one of the environments that the model was trained on, see core.specs.tool_spec; those of its other tasks
    differ in task, instruction and ground truth alone."""
    manifest: Mapping[str, Any]
    """Says how they were made; holds their checksums."""
    probe: PositionProbe | None = None
    """The judge's; None where the model was saved without it."""

    @property
    def sha256(self) -> str:
        return files_sha256(self.manifest)

    @property
    def tokenizer_sha256(self) -> str:
        return str(self.manifest["sha256"]["tokenizer"])

    def task_index(self, task: str) -> int:
        if task not in self.tasks:
            raise ModelFolderError(f"this world model knows the tasks {', '.join(self.tasks)}, not {task!r}")
        return self.tasks.index(task)


def save_model_folder(
    folder: Path, tokenizer: Tokenizer, action: ActionModel | TokenActionModel, text: TextModel | None,
    config: RunConfig, *, spec: EnvironmentSpec, tasks: tuple[str, ...], story: Mapping[str, Any],
    probe: PositionProbe | None = None, decoder: nn.Module | None = None, reader: nn.Module | None = None,
) -> Path:
    """Write the models, made with `config`, as float16 (buffers, and what is `exact`, as float32), and the manifest.

    Args:
        spec: of the environment whose episodes the models were trained on.
        story: further entries of the manifest: data, seeds, commands, metrics, machine, date.
        decoder: of rollouts, see train_decoder; None: the tokenizer's.
        reader: an ObjectReader; environments load it alone.
    """
    modules: dict[str, nn.Module | None] = {
        "tokenizer": tokenizer, "decoder": decoder, "action": action, "text": text, "probe": probe,
    }
    packed = {key: _pack(module) for key, module in modules.items() if module is not None}
    if reader is not None:
        packed["reader"] = pack_weights(reader).data
    for key in FILES.keys() - packed.keys():
        (folder / FILES[key]).unlink(missing_ok=True)
    manifest: dict[str, Any] = {
        "format": FORMAT,
        "tasks": list(tasks),
        "vocabulary": list(text.condition.vocabulary) if text else [],
        "spec": spec_values(tool_spec(spec)),
        "tokenizer": config.tokenizer.model_dump(),
        "world_model": config.world_model.model_dump(),
        "sha256": _hashes(packed),
        **story,
    }
    if text and isinstance(text.condition, SentenceCondition):
        encoder = text.condition.encoder
        manifest["world_model"]["text_encoder"], manifest["text_encoder_sha256"] = str(encoder.folder), encoder.sha256
    return write_model_folder(folder, {FILES[key]: data for key, data in packed.items()}, manifest)


def save_refreshed_folder(folder: Path, source: Path, action: ActionModel, story: Mapping[str, Any]) -> Path:
    """Write the folder `source` again with another action model; every other file is copied byte for byte.

    The manifest is that of the source, with the entries of `story` added or replaced.
    """
    manifest = read_world_manifest(source)
    packed = {key: (source / FILES[key]).read_bytes() for key in manifest["sha256"].keys() - {"action"}}
    packed["action"] = _pack(action)
    hashes = manifest["sha256"] | _hashes({"action": packed["action"]})
    manifest |= {"sha256": hashes, **story}
    return write_model_folder(folder, {FILES[key]: data for key, data in packed.items()}, manifest)


def load_model_folder(
    folder: Path, device: torch.device | str = "cpu", *, rollout_decoder: bool = True
) -> WorldModels:
    """Load and verify a model folder; weights come back as float32 on `device`, in evaluation mode, without gradients.

    rollout_decoder: False leaves the tokenizer the decoder that it was trained with.

    Raises:
        ModelFolderError: names the file, what is wrong, and the remedy.
    """
    manifest = read_world_manifest(folder)
    tokenizer_config = TokenizerConfig.model_validate(manifest["tokenizer"])
    config = WorldModelConfig.model_validate(manifest["world_model"])
    num_tasks, spec = len(manifest["tasks"]), model_spec(folder, manifest)
    num_positions = num_positions_of(spec, success_state=tokenizer_config.success_state)
    tokenizer = Tokenizer(tokenizer_config, spec.height, spec.width, num_positions)
    sizes: dict[str, Any] = {
        "num_tokens": tokenizer.num_tokens, "latent_dim": tokenizer.latent_dim, "num_positions": num_positions,
    }
    action = action_model_class(tokenizer_config.kind)(
        config, action_dim=spec.action_dim, state_dim=spec.state_dim, num_tasks=num_tasks, **state_sizes(spec),
        **sizes,
    )
    _load(folder, "tokenizer", tokenizer, manifest)
    if rollout_decoder and "decoder" in manifest["sha256"]:
        _load(folder, "decoder", tokenizer.decoder, manifest)
    _load(folder, "action", action, manifest)
    text = probe = None
    if "text" in manifest["sha256"]:
        text = TextModel(config, vocabulary=tuple(manifest["vocabulary"]), num_tasks=num_tasks, **sizes)
        _check_encoder(folder, text, manifest)
        _load(folder, "text", text, manifest)
    if "probe" in manifest["sha256"]:
        probe = PositionProbe(spec.height, spec.width, num_positions)
        _load(folder, "probe", probe, manifest)
    if "reader" in manifest["sha256"]:
        read_model_file(folder / READER, manifest["sha256"]["reader"])
    for module in (tokenizer, action, text, probe):
        if module is not None:
            module.to(device)
    return WorldModels(tokenizer, action, text, tuple(manifest["tasks"]), spec, manifest, probe)


def model_spec(folder: Path, manifest: Mapping[str, Any]) -> EnvironmentSpec:
    """The spec in a world model's manifest. Raises ModelFolderError: it has none, or another version's."""
    try:
        return spec_of_values(manifest["spec"])
    except (KeyError, ValueError) as error:
        raise ModelFolderError(f"{folder} has no usable spec in its manifest ({error}); train it anew with this "
                               "version") from None


def action_model_class(kind: str) -> type[ActionModel] | type[TokenActionModel]:
    """Return the class of action model that goes with a tokenizer of `kind`."""
    return TokenActionModel if kind == "lfq" else ActionModel


def read_world_manifest(folder: Path) -> dict[str, Any]:
    """Read the manifest of a world-model folder. Raises ModelFolderError."""
    return read_manifest(folder, "world model", FORMAT)


def _check_encoder(folder: Path, text: TextModel, manifest: Mapping[str, Any]) -> None:
    if isinstance(text.condition, SentenceCondition):
        encoder, wanted = text.condition.encoder, manifest["text_encoder_sha256"]
        if encoder.sha256 != wanted:
            raise ModelFolderError(
                f"{folder} was trained with another sentence encoder (sha256 {wanted[:12]}) than {encoder.folder} "
                f"holds ({encoder.sha256[:12]}); put that one there"
            )


def _load(folder: Path, key: str, module: nn.Module, manifest: Mapping[str, Any]) -> None:
    path = Path(folder) / FILES[key]
    expected = module.state_dict()
    try:
        tensors = load(read_model_file(path, manifest["sha256"][key]))
        tensors = {name: t.to(expected[name].dtype) if name in expected else t for name, t in tensors.items()}
        check_same_layout(expected, tensors, what=str(path))
    except (SafetensorError, WeightsError) as error:
        raise ModelFolderError(f"{error}; train it anew with this version") from None
    module.load_state_dict(tensors)
    module.eval().requires_grad_(False)


def _pack(module: nn.Module) -> bytes:
    """Return a module's weights as safetensors: float16, those of parts that are `exact` as they are, and so the
    buffers: shift and scale of states and positions have any unit, and in float16 lose what they differ by."""
    tensors = {name: tensor.detach().cpu() for name, tensor in module.state_dict().items()}
    exact = tuple(f"{name}." for name, part in module.named_modules() if getattr(part, "exact", False))
    halved = {name for name, _ in module.named_parameters() if not name.startswith(exact)}
    data: bytes = save({name: (t.half() if name in halved else t).contiguous() for name, t in tensors.items()})
    return data


def _hashes(packed: Mapping[str, bytes]) -> dict[str, str]:
    return {key: hashlib.sha256(data).hexdigest() for key, data in packed.items()}
