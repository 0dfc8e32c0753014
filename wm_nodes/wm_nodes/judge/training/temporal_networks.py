"""Train the temporal networks ("readers") of the embedded judge by cross-fitting (RA-17).

The trees use the networks' answers as evidence, so these must be as reliable in training as on new clips. Therefore
each network is trained on half of the recordings, and a training clip gets the mean answer of the networks that were
not trained on its recording; every other clip gets the mean of all. Shapes: N clips, T frames, K questions, in the
order of READS.
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import save
from torch import Tensor

from wm_nodes.core.device import CPU_DEVICE
from wm_nodes.core.files import write_atomic
from wm_nodes.core.model_folder import AGAIN
from wm_nodes.core.progress import tqdm
from wm_nodes.core.seeding import numpy_stream, stream_seed
from wm_nodes.core.types import FloatArray
from wm_nodes.judge.dataset.edits.manifest import ManifestRow
from wm_nodes.judge.evidence import sequence
from wm_nodes.judge.evidence.sequence import READS, RIGHTWARD, ObjectSequence, TemporalNetwork, readings
from wm_nodes.judge.training.heads import LAST_FAIL, UNKNOWN, Levels, true_levels
from wm_nodes.training.checkpoint import read_tensors
from wm_nodes.world_model.precision import compute_context

FOLDS = 2
BATCH = 64
LEARNING_RATE, WEIGHT_DECAY = 1.5e-3, 0.05
MIN_STEPS = 11
"""The schedule divides by zero at 10."""
SMOOTHING = 0.01
"""Of the labels."""
GAIN, OFFSET_LEVELS, NUMBER_NOISE = 0.2, 12.0, 0.02
"""Largest change of a colour's gain and offset; standard deviation of what is added to the numbers."""
EXCHANGES = torch.tensor([[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]])


@dataclass(frozen=True, eq=False)
class TemporalData:
    """sequences: of N clips. answers: int64 (N, K), 1 yes, 0 no, UNKNOWN. folds: (N,), of the clips' recordings."""

    sequences: Sequence[ObjectSequence]
    answers: Levels
    folds: Levels


def temporal_data(sequences: Sequence[ObjectSequence], rows: Sequence[ManifestRow]) -> TemporalData:
    """Training data of the readers: sequences, answers by label, and folds by recording."""
    answers = [_answers(question, rows) for question in READS]
    return TemporalData(sequences, np.stack(answers, 1), np.array([row.origin.seed % FOLDS for row in rows], np.int64))


def _answers(question: str, rows: Sequence[ManifestRow]) -> Levels:
    levels = true_levels(question, rows)
    return np.where(levels == UNKNOWN, UNKNOWN, levels > LAST_FAIL.get(question, 0)).astype(np.int64)


def cross_fit(
    folder: Path, data: TemporalData, *, count: int, epochs: int, seed: int, progress: bool = True,
    device: torch.device = CPU_DEVICE,
) -> tuple[tuple[TemporalNetwork, ...], FloatArray]:
    """`count` readers per fold, and log-odds (N, K) of every clip, the mean of those that have not seen its recording.

    Args:
        folder: of finished readers, which are loaded, whatever device made them; the file names hash everything else
            that they depend on.

    Raises:
        ValueError: one of the folds has no clips. OSError: a full disk.
    """
    readers, log_odds = [], np.zeros(data.answers.shape, np.float32)
    for fold in range(FOLDS):
        trained = np.flatnonzero(data.folds != fold)
        if not len(trained) or len(trained) == len(data.folds):
            raise ValueError(f"recordings of one parity of seeds only: {len(data.folds)} clips; build larger sets")
        seeds = [stream_seed(seed, "reader", fold + FOLDS * number) for number in range(count)]
        own = [_load_or_train_reader(folder, data, trained, epochs, each, progress, device) for each in seeds]
        for i in np.flatnonzero(data.folds == fold):
            log_odds[i] = list(readings(own, data.sequences[i]).values())
        readers += own
    return tuple(readers), log_odds


def _load_or_train_reader(
    folder: Path, data: TemporalData, trained: Levels, epochs: int, seed: int, progress: bool,
    device: torch.device,
) -> TemporalNetwork:
    path = folder / f"reader-{_key(data, trained, epochs, seed)}.safetensors"
    if not path.exists():
        reader = train_temporal_network(data, trained, epochs=epochs, seed=seed, progress=progress, device=device)
        write_atomic(path, save(dict(reader.state_dict())))
    reader = TemporalNetwork().eval().requires_grad_(False)
    reader.load_state_dict(read_tensors(path, AGAIN))
    return reader.to(device)


def _key(data: TemporalData, chosen: Levels, epochs: int, seed: int) -> str:
    digest = hashlib.sha256(f"{epochs} {seed}".encode())
    digest.update(Path(__file__).read_bytes() + Path(sequence.__file__).read_bytes() + data.answers[chosen].tobytes())
    for i in chosen:
        digest.update(data.sequences[i].crops.tobytes() + data.sequences[i].numbers.tobytes())
    return digest.hexdigest()[:16]


def train_temporal_network(
    data: TemporalData, chosen: Levels, *, epochs: int, seed: int, progress: bool = True,
    device: torch.device = CPU_DEVICE,
) -> TemporalNetwork:
    """Minimise the weighted logistic loss of the known answers with AdamW; batches are of clips of one length."""
    with torch.random.fork_rng([]):
        torch.manual_seed(seed)
        reader = TemporalNetwork().train().to(device)
        rng = numpy_stream(seed, "reader_batches")
        numbers = np.concatenate([data.sequences[i].numbers for i in chosen])
        reader.mean.copy_(torch.from_numpy(numbers.mean(0)))
        reader.scale.copy_(torch.from_numpy(numbers.std(0) + 1e-2))
        weights = _weights(data.answers[chosen]).to(device)
        batches = [batch for _ in range(epochs) for batch in _batches(data, chosen, rng)]
        optimiser = torch.optim.AdamW(reader.parameters(), LEARNING_RATE, weight_decay=WEIGHT_DECAY)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, LEARNING_RATE, total_steps=max(MIN_STEPS, len(batches)), pct_start=0.1
        )
        for batch in (steps := tqdm(batches, "reader", disable=not progress)):
            crops, known = _augment(*_stack(data, batch, device), rng)
            wanted = torch.from_numpy(data.answers[batch]).to(device)
            weight = torch.where(wanted > 0, weights[1], weights[0]) * (wanted != UNKNOWN)
            aim = wanted.clamp(0).float() * (1 - 2 * SMOOTHING) + SMOOTHING
            with compute_context(device):
                answers = reader(crops, known)
            loss = F.binary_cross_entropy_with_logits(answers.float(), aim, weight, reduction="sum")
            loss = loss / (wanted != UNKNOWN).sum().clamp(min=1)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            schedule.step()
            steps.set_postfix(loss=f"{loss.item():.3f}", refresh=False)
    rounded = {name: tensor.half().float() for name, tensor in reader.state_dict().items()}
    reader.load_state_dict(rounded)
    return reader.eval().requires_grad_(False)


def _weights(answers: Levels) -> Tensor:
    """Loss weights (2, K) of no and yes: square roots of the balancing weights, so that rare faults count more."""
    known = (answers != UNKNOWN).sum(0)
    counts = np.stack([(answers == answer).sum(0) for answer in (0, 1)])
    return torch.from_numpy(np.sqrt(0.5 * known / np.maximum(counts, 1)).astype(np.float32))


def _batches(data: TemporalData, chosen: Levels, rng: np.random.Generator) -> Iterator[Levels]:
    """Every chosen clip once, BATCH of one length at a time, in random order."""
    lengths = np.array([len(data.sequences[i].crops) for i in chosen])
    batches = []
    for length in np.unique(lengths):
        alike = rng.permutation(chosen[lengths == length])
        batches += [alike[start : start + BATCH] for start in range(0, len(alike), BATCH)]
    yield from (batches[i] for i in rng.permutation(len(batches)))


def _stack(data: TemporalData, batch: Levels, device: torch.device) -> tuple[Tensor, Tensor]:
    crops, numbers = (np.stack([getattr(data.sequences[i], name) for i in batch]) for name in ("crops", "numbers"))
    return torch.from_numpy(crops).to(device), torch.from_numpy(numbers).to(device)


def _augment(crops: Tensor, numbers: Tensor, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Augment clips: half mirrored, half with exchanged colours; random colour gains and offsets, noise on numbers."""
    count, device = len(crops), crops.device
    mirrored = torch.from_numpy(rng.random(count) < 0.5).to(device)
    crops = torch.where(mirrored[:, None, None, None, None], crops.flip(3), crops)
    sign = torch.ones(numbers.shape[-1])
    sign[list(RIGHTWARD)] = -1
    noise = NUMBER_NOISE * torch.randn(numbers.shape)
    numbers = torch.where(mirrored[:, None, None], numbers * sign.to(device), numbers) + noise.to(device)
    kinds = np.where(rng.random(count) < 0.5, 0, rng.integers(0, len(EXCHANGES), count))
    order = EXCHANGES[torch.from_numpy(kinds)].to(device)[:, None, None, None, :].expand(*crops.shape[:-1], 3)
    draws = (rng.uniform(-1, 1, (count, 1, 1, 1, 3)).astype(np.float32) for _ in range(2))
    gain, offset = (torch.from_numpy(draw).to(device) for draw in draws)
    colours = torch.gather(crops[..., :3], -1, order).float() * (1 + GAIN * gain) + OFFSET_LEVELS * offset
    return torch.cat((colours.clamp_(0, 255).to(torch.uint8), crops[..., 3:]), -1), numbers
