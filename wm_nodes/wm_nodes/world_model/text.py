"""WM_txt and the goals it imagines (RS-6). Shapes: B batch, T frames, S tokens, D values per token, L words of the
longest instruction, R rows: one where all instructions of a batch are equal, else B."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from wm_nodes.config.schema import WorldModelConfig
from wm_nodes.config.tasks import get_task, parts_of, task_names
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import BoolArray, UInt8Array
from wm_nodes.world_model.conditions import text_rows, word_mask
from wm_nodes.world_model.dynamics import FrameModel, Prediction, task_done_signal
from wm_nodes.world_model.precision import compute_context
from wm_nodes.world_model.sentence_encoder import SentenceCondition, SentenceEncoder
from wm_nodes.world_model.tokenizer import NUM_POSITIONS, Tokenizer
from wm_nodes.world_model.transformer import RingCache, TemporalCache

MAX_WORDS = 12


class InstructionCondition(nn.Module):
    """A learned embedding per word of the closed instruction templates, plus a null token."""

    def __init__(self, vocabulary: tuple[str, ...], width: int) -> None:
        super().__init__()
        self.vocabulary = vocabulary
        self._index = {word: i for i, word in enumerate(vocabulary)}
        self.words = nn.Embedding(len(vocabulary), width)
        self.position = nn.Parameter(torch.randn(MAX_WORDS, width) * 0.1)
        self.null = nn.Parameter(torch.randn(1, width) * 0.5)

    def forward(self, instructions: Sequence[str]) -> tuple[Tensor, Tensor | None]:
        """Condition tokens (R, L + 1, D) of one instruction per row of the batch, and a mask (R, L + 1), True where a
        token is none of the padding of shorter instructions; None where all are equally long.

        Raises:
            ValueError: a word that the model was not trained on, or too many words.
        """
        rows = [self._places(instruction) for instruction in text_rows(instructions)]
        lengths = [len(row) for row in rows]
        padded = [row + [0] * (max(lengths) - len(row)) for row in rows]
        words = self.words(torch.tensor(padded, device=self.null.device)) + self.position[: max(lengths)]
        tokens = torch.cat((words, self.null.expand(len(rows), -1, -1)), 1)
        return tokens, word_mask(lengths, self.null.device)

    def _places(self, instruction: str) -> list[int]:
        words = instruction.lower().split()
        unknown = [word for word in words if word not in self._index]
        if unknown or not 0 < len(words) <= MAX_WORDS:
            raise ValueError(
                f"instruction {instruction!r}: {'unknown words ' + ', '.join(unknown) if unknown else 'length'}; this "
                f"model knows at most {MAX_WORDS} of {', '.join(self.vocabulary)}"
            )
        return [self._index[word] for word in words]


class TextModel(FrameModel):
    """The same architecture as WM_act; its condition is a row's instruction, equal for all its frames."""

    def __init__(
        self, config: WorldModelConfig, *, num_tokens: int, latent_dim: int, vocabulary: tuple[str, ...],
        num_tasks: int, num_positions: int = NUM_POSITIONS,
    ) -> None:
        super().__init__(config, num_tokens, latent_dim, num_tasks, num_positions)
        self.condition: InstructionCondition | SentenceCondition = (
            SentenceCondition(SentenceEncoder(Path(config.text_encoder)), config.width) if config.text_encoder
            else InstructionCondition(vocabulary, config.width)
        )

    def forward(
        self, latents_BTSD: Tensor, instructions: Sequence[str],
        caches: list[TemporalCache] | list[RingCache] | None = None,
    ) -> Prediction:
        tokens, visible = self.condition_of(instructions, *latents_BTSD.shape[:2])
        return self.predict(latents_BTSD, tokens, caches, visible)

    def knows(self, instruction: str) -> bool:
        """Whether it was trained on the words of an instruction."""
        try:
            self.condition([instruction])
        except ValueError:
            return False
        return True

    def condition_of(self, instructions: Sequence[str], batch: int, frames: int) -> tuple[Tensor, Tensor | None]:
        """The condition (B, T, L + 1, D) of every frame, and its mask (B, L + 1)."""
        tokens, visible = self.condition(instructions)
        return tokens.unsqueeze(1).expand(batch, frames, -1, -1), visible


def instruction_for(task: str, recorded_task: str, own: str, otherwise: str) -> str:
    """The instruction of an episode for `task`: its own where it was recorded for that task and has one, else that of
    the task, `otherwise`."""
    return own if own and recorded_task in (task, *parts_of(task)) else otherwise


def task_instruction(task: str, spec: EnvironmentSpec) -> str:
    """Of the task's file, or of the environment where it has none."""
    return get_task(task).instruction if task in task_names() else spec.instruction


def vocabulary_of(instructions: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(sorted({word for text in instructions for word in text.lower().split()}))


@dataclass(frozen=True)
class ImaginedGoals:
    """Golden trajectories of B first frames."""

    frames: UInt8Array
    """uint8 (B, T + 1, H, W, 3), from the first frame."""
    lengths: np.ndarray[tuple[int], np.dtype[np.int64]]
    """int64 (B,), frames up to and with the goal."""
    found: BoolArray
    """bool (B,), whether the done signal crossed the threshold; else the goal is the frame of the highest signal."""

    @property
    def goals(self) -> UInt8Array:
        """Goal frames (B, H, W, 3)."""
        chosen: UInt8Array = self.frames[np.arange(len(self.frames)), self.lengths - 1]
        return chosen


@torch.inference_mode()
def imagine_goals(
    model: TextModel, tokenizer: Tokenizer, images: UInt8Array, instructions: Sequence[str], tasks: Sequence[int], *,
    horizon: int, threshold: float,
) -> ImaginedGoals:
    """Roll the text model out from frames (B, H, W, 3), their B instructions and tasks (WorldModels.task_index); the
    goal is the first frame whose done signal is above `threshold` (RS-6: t* = min{t : d_t > tau_goal}), else that of
    the highest, with found=False."""
    current = tokenizer.encode(images).unsqueeze(1)
    caches = model.trunk.new_ring_caches(len(images), current.device)
    frames, signals = [np.asarray(images)], list[Tensor]()
    tasks_B = torch.tensor(tasks, device=current.device)
    for _ in range(horizon):
        with compute_context(current.device):
            prediction = model(current, instructions, caches)
        current = tokenizer.normalise(current + prediction.change_BTSD)
        frames.append(tokenizer.decode(current[:, 0]).cpu().numpy())
        signals.append(task_done_signal(prediction.done_logits_BTKJ[:, 0], tasks_B)[0])
    signal_BT = torch.stack(signals, 1).cpu().numpy()
    crossed = signal_BT > threshold
    found = crossed.any(1)
    first = np.where(found, crossed.argmax(1), signal_BT.argmax(1))
    return ImaginedGoals(np.stack(frames, 1), first.astype(np.int64) + 2, found)
