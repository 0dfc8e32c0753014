"""A public model in a local folder of the diffusers layout: safetensors only, no network, no code from the folder.

model_index.json                      which pipeline it belongs to
transformer/ vae/ text_encoder/       config.json and *.safetensors
tokenizer/  scheduler/                their configuration
"""

from pathlib import Path
from typing import Any

import torch

from wm_nodes.core.model_folder import ModelFolderError, read_json
from wm_nodes.video_model.adapters.packages import package

REMEDY = "download the whole model again in its diffusers layout (with safetensors), and name that folder"
TEXT_ENCODERS = ("UMT5EncoderModel", "Qwen2_5_VLForConditionalGeneration")


class ModelFolder:
    """Reads the parts of one folder.

    Raises:
        ModelFolderError: from every method, naming the path and what to do.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise ModelFolderError(f"{self.folder} is not a folder; {REMEDY}")
        self.index = self._json("model_index.json")

    @property
    def pipeline(self) -> str:
        """Name of the pipeline class, as in model_index.json."""
        return str(self.index.get("_class_name"))

    def has(self, part: str) -> bool:
        """Whether model_index.json names this part and does not leave it empty."""
        entry = self.index.get(part)
        return isinstance(entry, list) and entry[-1] is not None

    def scheduler(self) -> dict[str, Any]:
        return self._json("scheduler/scheduler_config.json")

    def model(self, part: str, class_name: str, dtype: torch.dtype) -> Any:
        """Load a diffusers model, with every weight from the folder."""
        path = self._check_part(part)
        name = self._json(f"{part}/config.json").get("_class_name")
        if name != class_name:
            raise ModelFolderError(f"{path} holds a {name}, not a {class_name}; {REMEDY}")
        return self._load(getattr(package("diffusers"), class_name), path, dtype)

    def text_encoder(self, dtype: torch.dtype) -> Any:
        path = self._check_part("text_encoder")
        name = self.index["text_encoder"][-1] if self.has("text_encoder") else None
        if name not in TEXT_ENCODERS:
            raise ModelFolderError(f"{path} holds a {name}; supported text encoders are {', '.join(TEXT_ENCODERS)}")
        return self._load(getattr(package("transformers"), name), path, dtype)

    def tokenizer(self) -> Any:
        path = self.folder / "tokenizer"
        if not path.is_dir():
            raise ModelFolderError(f"{path} is missing; {REMEDY}")
        auto = package("transformers").AutoTokenizer
        try:
            return auto.from_pretrained(str(path), local_files_only=True, trust_remote_code=False)
        except (OSError, ValueError, KeyError, ImportError) as error:
            raise ModelFolderError(f"{path} cannot be read as a tokenizer ({error}); {REMEDY}") from error

    def _load(self, cls: Any, path: Path, dtype: torch.dtype) -> Any:
        try:
            model, report = cls.from_pretrained(
                str(path), torch_dtype=dtype, use_safetensors=True, local_files_only=True, output_loading_info=True
            )
        except Exception as error:  # torch, safetensors and both libraries raise kinds of their own
            raise ModelFolderError(
                f"{path} cannot be loaded as {cls.__name__} ({type(error).__name__}: {error}); {REMEDY}"
            ) from error
        absent = sorted(str(name) for name in report["missing_keys"])
        if absent:
            raise ModelFolderError(
                f"{path} lacks {len(absent)} weights of its {cls.__name__}, the first {absent[0]}; {REMEDY}"
            )
        return model.eval()

    def _check_part(self, part: str) -> Path:
        """Return the part's folder after checking that its configuration and weight files are all there."""
        path = self.folder / part
        self._json(f"{part}/config.json")
        indices = sorted(path.glob("*.safetensors.index.json"))
        if indices:
            wanted = set(self._json(f"{part}/{indices[0].name}").get("weight_map", {}).values())
            absent = sorted(name for name in wanted if not (path / name).is_file())
            if absent:
                raise ModelFolderError(f"{path} lacks {', '.join(absent)}; {REMEDY}")
        elif not list(path.glob("*.safetensors")):
            pickles = sorted(p.name for pattern in ("*.bin", "*.pt", "*.pth", "*.ckpt") for p in path.glob(pattern))
            kinds = f" but {', '.join(pickles)}, which can run code when loaded" if pickles else ""
            raise ModelFolderError(f"{path} holds no *.safetensors{kinds}; {REMEDY}")
        return path

    def _json(self, name: str) -> dict[str, Any]:
        return read_json(self.folder / name, REMEDY)
