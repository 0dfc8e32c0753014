"""Train the embedded judge on adversarial sets: segmenter, evidence, heads, limits (RA-17 to RA-20).

Finished stages are files of the folder and are loaded by the next call: segmenter.safetensors, evidence-*.npz and
sequences-*.npz per set and part, and reader-*.safetensors. Their names hash everything they depend on.
"""

import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save

import wm_nodes.judge.evidence
from wm_nodes.config.seed_ranges import seed_spans
from wm_nodes.core.device import CPU_DEVICE
from wm_nodes.core.files import write_atomic
from wm_nodes.core.model_folder import AGAIN, read_json
from wm_nodes.core.progress import tqdm
from wm_nodes.core.types import FloatArray
from wm_nodes.judge.dataset.edits.clips import COMPONENTS, TC
from wm_nodes.judge.dataset.edits.manifest import Manifest, ManifestRow, Part, to_bytes
from wm_nodes.judge.dataset.policy_camera import SEEN
from wm_nodes.judge.dataset.set_files import load_frames
from wm_nodes.judge.evidence.clip import measure_clip
from wm_nodes.judge.evidence.head import JudgeHead
from wm_nodes.judge.evidence.segmentation import Segmenter
from wm_nodes.judge.evidence.sequence import ObjectSequence, TemporalNetwork, reading_names, readings
from wm_nodes.judge.evidence.trees import TreeSettings
from wm_nodes.judge.evidence.window import Window
from wm_nodes.judge.training.data import load_sets, rows_of, set_clips
from wm_nodes.judge.training.heads import (
    TARGETS,
    Examples,
    conformal_limits,
    fit_all,
    fit_familiarity,
    measure_target,
    sharpness_limit,
)
from wm_nodes.judge.training.segmenter import overlaps, segmentation_data, train_segmenter
from wm_nodes.judge.training.temporal_networks import cross_fit, temporal_data
from wm_nodes.training.checkpoint import read_tensors

SEGMENTER = "segmenter.safetensors"
Sets = Sequence[tuple[Path, Manifest]]


@dataclass(frozen=True)
class JudgePlan:
    """Settings of a judge's training."""

    sets: tuple[Path, ...]
    """Folders of adversarial sets."""
    segmenter_steps: int = 2800
    """Batches that the segmenter is trained on."""
    readers: int = 1
    """Temporal networks per half of the recordings."""
    reader_epochs: int = 16
    trees: TreeSettings = field(default_factory=TreeSettings)
    seed: int = 0
    window: Window | None = None
    """The part of the judged pictures that the clips show, for sets of the policy's camera (policy_camera.py)."""


def make_judge(
    folder: Path, plan: JudgePlan, *, progress: bool = True, device: torch.device = CPU_DEVICE
) -> JudgeHead:
    """Train every part of a judge; the head's story holds the data, the seeds and the metrics on the validation part.

    device: that the networks compute on. A stage that another device finished is taken up.

    Raises:
        ManifestError: a damaged set. ValueError: sets too small to learn from. OSError: a full disk.
    """
    sets = load_sets(plan.sets)
    windows = {row.origin.camera == SEEN for _, manifest in sets for row in manifest.rows}
    if windows != {plan.window is not None}:
        raise ValueError(
            "a judge reads either the clips of --policy-view or others: give --policy-view to sets that were made so, "
            "and to no other"
        )
    segmenter, segmenter_story = _load_or_train_segmenter(folder, sets, plan, progress, device)
    train, validation = (
        collect_evidence(folder, sets, part, segmenter, progress=progress) for part in ("train", "validation")
    )
    if not len(train.rows) or not len(validation.rows):
        raise ValueError(f"{len(train.rows)} training and {len(validation.rows)} validation clips; build larger sets")
    readers: tuple[TemporalNetwork, ...] = ()
    if plan.readers:
        data = temporal_data(collect_sequences(folder, sets, "train", segmenter), train.rows)
        readers, log_odds = cross_fit(
            folder, data, count=plan.readers, epochs=plan.reader_epochs, seed=plan.seed, progress=progress,
            device=device,
        )
        train = with_readings(train, log_odds)
        validation = _add_readings(folder, sets, "validation", segmenter, readers, validation)
    questions = fit_all(train, validation, plan.trees, plan.seed, progress=progress)
    low, high = np.quantile(train.evidence[train.clean], (0.05, 0.95), axis=0).astype(np.float32)
    recorded = [
        load_frames(path, row.sha256).shape for path, manifest in sets for row in rows_of(manifest, ["train"])
        if row.sha256 == row.root
    ]
    num_frames = [shape[0] for shape in recorded]
    lengths = (-(-2 * min(num_frames) // 3), 3 * max(num_frames) // 2)
    story = {
        "data": [_describe_set(path, manifest) for path, manifest in sets], "seed": plan.seed,
        "fitted": {"train": len(train.rows), "validation": len(validation.rows)},
        "segmenter": segmenter_story, "trees": vars(plan.trees), "reader_epochs": plan.reader_epochs,
        "tasks": sorted({row.origin.task for row in train.rows}),
        "cameras": sorted({row.origin.camera.split()[0] for row in train.rows}),
        "validation": {target: measure_target(questions, target, validation) for target in TARGETS},
        "conformal": {target: conformal_limits(questions, target, validation) for target in (*COMPONENTS, TC)},
    }
    known = fit_familiarity(train, validation)
    size = (recorded[0][1], recorded[0][2])
    return JudgeHead(
        segmenter, train.names, questions, known, low, high, size, lengths, story, window=plan.window, readers=readers,
        sharpness_limit=sharpness_limit(validation),
    )


def collect_evidence(
    folder: Path, sets: Sets, part: Part, segmenter: Segmenter, readers: Sequence[TemporalNetwork] = (), *,
    progress: bool = True,
) -> Examples:
    """Evidence of every clip of a part of all sets, with the readers' answers last; cached in `folder` per set."""
    names: tuple[str, ...] = ()
    values, rows = [], []
    for path, manifest in sets:
        chosen = rows_of(manifest, [part])
        if not chosen:
            continue
        with np.load(_measure_part(folder, path, manifest, part, segmenter, progress)[0], allow_pickle=False) as arrays:
            names = tuple(str(name) for name in arrays["names"])
            values.append(arrays["values"])
        rows += chosen
    examples = Examples(names, np.concatenate(values) if values else np.zeros((0, 0), np.float32), rows)
    return _add_readings(folder, sets, part, segmenter, readers, examples) if readers and rows else examples


def collect_sequences(folder: Path, sets: Sets, part: Part, segmenter: Segmenter) -> list[ObjectSequence]:
    """The object sequence of every clip of a part of all sets; collect_evidence must have run before."""
    collected = []
    for path, manifest in sets:
        if rows_of(manifest, [part]):
            _, file = _measure_part(folder, path, manifest, part, segmenter, False)
            with np.load(file, allow_pickle=False) as arrays:
                ends = np.cumsum(arrays["lengths"])[:-1]
                both = (np.split(arrays[name], ends) for name in ("crops", "numbers"))
                collected += [ObjectSequence(*pair) for pair in zip(*both, strict=True)]
    return collected


def with_readings(examples: Examples, log_odds: FloatArray) -> Examples:
    """The examples with the readers' log-odds (N, K) as their last evidence."""
    evidence = np.concatenate([examples.evidence, log_odds], 1)
    return Examples(examples.names + reading_names(), evidence, examples.rows)


def _add_readings(
    folder: Path, sets: Sets, part: Part, segmenter: Segmenter, readers: Sequence[TemporalNetwork], examples: Examples
) -> Examples:
    sequences = collect_sequences(folder, sets, part, segmenter)
    answers = [list(readings(readers, sequence).values()) for sequence in sequences]
    return with_readings(examples, np.array(answers, np.float32))


def _measure_part(
    folder: Path, path: Path, manifest: Manifest, part: Part, segmenter: Segmenter, progress: bool
) -> tuple[Path, Path]:
    """Paths of the evidence and the sequences of a set's part, which are measured where the files are missing."""
    chosen = rows_of(manifest, [part])
    key = _key(chosen, segmenter)
    evidence, sequences = (folder / f"{name}-{key}.npz" for name in ("evidence", "sequences"))
    if not evidence.exists() or not sequences.exists():
        name = f"evidence of {path.name} {part}"
        clips = tqdm(set_clips([(path, manifest)], [part]), name, len(chosen), disable=not progress)
        measurements = [measure_clip(segmenter, c.frames, c.task.reference_frame, c.task.instruction) for c in clips]
        _keep(
            sequences, lengths=np.array([len(sequence.crops) for _, sequence in measurements]),
            crops=np.concatenate([sequence.crops for _, sequence in measurements]),
            numbers=np.concatenate([sequence.numbers for _, sequence in measurements]),
        )
        values = np.array([list(numbers.values()) for numbers, _ in measurements], np.float32)
        _keep(evidence, names=np.array(list(measurements[0][0])), values=values)
    return evidence, sequences


def _keep(path: Path, **arrays: NDArray[Any]) -> None:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomic(path, buffer.getvalue())


def _key(rows: Sequence[ManifestRow], segmenter: Segmenter) -> str:
    """Hash of the clips, their reference frames and instructions, the segmenter's weights and the code."""
    shown = "".join(f"{row.sha256} {row.root} {row.origin.task} {row.origin.object_id}\n" for row in rows)
    weights = hashlib.sha256(save(dict(segmenter.state_dict()))).digest()
    return hashlib.sha256(shown.encode() + weights + _code_digest()).hexdigest()[:16]


def _load_or_train_segmenter(
    folder: Path, sets: Sets, plan: JudgePlan, progress: bool, device: torch.device
) -> tuple[Segmenter, dict[str, Any]]:
    """Load the segmenter of the folder, or train it; return it and how it was trained. Weights are of float16."""
    path = folder / SEGMENTER
    if not path.exists():
        images, masks = segmentation_data(set_clips(sets, ["train"]), plan.seed)
        model = train_segmenter(
            images, masks, num_steps=plan.segmenter_steps, seed=plan.seed, progress=progress, device=device
        )
        validation = segmentation_data(set_clips(sets, ["validation"]), plan.seed)
        story = {
            "sets": [str(folder.name) for folder, _ in sets], "pictures": len(images), "steps": plan.segmenter_steps,
            "seed": plan.seed, "overlap": {name: round(iou, 4) for name, iou in overlaps(model, *validation).items()},
        }
        write_atomic(path.with_suffix(".json"), (json.dumps(story, indent=1) + "\n").encode())
        write_atomic(path, save({name: tensor.half() for name, tensor in model.state_dict().items()}))
    segmenter = Segmenter()
    segmenter.load_state_dict({name: tensor.float() for name, tensor in read_tensors(path, AGAIN).items()})
    story = read_json(path.with_suffix(".json"), AGAIN)
    return segmenter.eval().requires_grad_(False).to(device), story


def _describe_set(path: Path, manifest: Manifest) -> dict[str, Any]:
    parts = {part: sum(row.part == part for row in manifest.rows) for part in ("train", "validation", "test")}
    return {
        "set": path.name, "manifest_sha256": hashlib.sha256(to_bytes(manifest)).hexdigest(), "clips": parts,
        "training_seeds": seed_spans(row.origin.seed for row in manifest.rows if row.part != "test"),
    }


def _code_digest() -> bytes:
    """Hash of the code that computes evidence."""
    folder = Path(str(wm_nodes.judge.evidence.__path__[0]))
    others = ("__init__", "head", "trees", "window")
    files = (path for path in sorted(folder.glob("*.py")) if path.stem not in others)
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).digest()
