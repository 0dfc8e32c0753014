"""A public sentence encoder, frozen, as reader of the text model's instructions: MiniLM, T5 and their like.

Shapes: R rows, L words of the longest instruction, E values of the encoder per word, D width.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from wm_nodes.core.imports import optional_package
from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.world_model.conditions import text_rows, word_mask

UNUSED = ("decoder.", "pooler.")
"""Weights that may be missing: what makes more of the words' last hidden states than they are."""


class SentenceEncoder:
    """Encoder and tokenizer of a local folder in the layout of transformers, on the CPU; no code from the folder runs.

    Attributes:
        folder: its full path. sha256: of its weights. width: E.

    Raises:
        ModelFolderError: the folder is missing or holds no such encoder. MissingPackageError: no transformers.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.expanduser().absolute()
        files = sorted(self.folder.glob("*.safetensors"))
        if not files or not (self.folder / "config.json").is_file():
            raise ModelFolderError(
                f"{self.folder} (world_model.text_encoder) holds no config.json with *.safetensors; put the sentence "
                "encoder there"
            )
        self.sha256 = hashlib.sha256(b"".join(hashlib.sha256(file.read_bytes()).digest() for file in files)).hexdigest()
        needed_by = "world_model.text_encoder needs"
        transformers = optional_package("transformers", needed_by=needed_by, requirements="video.txt")
        local = {"local_files_only": True, "trust_remote_code": False}
        try:
            with torch.random.fork_rng(devices=[]):  # what is missing is drawn
                self._tokenizer = transformers.AutoTokenizer.from_pretrained(self.folder, **local)
                model, report = transformers.AutoModel.from_pretrained(
                    self.folder, dtype=torch.float32, use_safetensors=True, output_loading_info=True, **local
                )
        except Exception as error:  # the library raises many kinds
            raise ModelFolderError(f"{self.folder} is no sentence encoder ({error}); copy the whole folder") from error
        if missing := sorted(name for name in report["missing_keys"] if not name.startswith(UNUSED)):
            raise ModelFolderError(f"{self.folder} lacks weights, the first {missing[0]}; copy the whole folder")
        encoder = model.encoder if hasattr(model, "decoder") else model
        self._encoder = encoder.eval().requires_grad_(False)
        self.width = int(model.config.hidden_size)

    def encode(self, text: str) -> Tensor:
        """Last hidden states (L, E) of the words of one text."""
        with torch.inference_mode(False), torch.no_grad(), torch.autocast("cpu", enabled=False):
            words = self._tokenizer(text, return_tensors="pt")
            states: Tensor = self._encoder(**{key: words[key] for key in ("input_ids", "attention_mask")})[0]
            return states[0]


class SentenceCondition(nn.Module):
    """The encoder's words, each through one linear layer, plus a null token; see InstructionCondition, which knows a
    closed vocabulary. The encoder is neither trained nor part of the weights; a text is encoded once."""

    vocabulary: tuple[str, ...] = ()

    def __init__(self, encoder: SentenceEncoder, width: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.project = nn.Linear(encoder.width, width)
        self.null = nn.Parameter(torch.randn(1, width) * 0.5)
        self._encoded: dict[str, Tensor] = {}

    def forward(self, instructions: Sequence[str]) -> tuple[Tensor, Tensor | None]:
        """Condition tokens (R, L + 1, D) and mask (R, L + 1), as InstructionCondition's."""
        rows = [self._words(text) for text in text_rows(instructions)]
        words = self.project(pad_sequence(rows, batch_first=True).to(self.null.device))
        tokens = torch.cat((words, self.null.to(words.dtype).expand(len(rows), -1, -1)), 1)
        return tokens, word_mask([len(row) for row in rows], self.null.device)

    def _words(self, text: str) -> Tensor:
        if text not in self._encoded:
            self._encoded[text] = self.encoder.encode(text)
        return self._encoded[text]
