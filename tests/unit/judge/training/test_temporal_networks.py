"""The network over time: what it reads, that it learns, and that no clip is read by a reader that was trained on it."""

import functools
from pathlib import Path

import numpy as np
import pytest
import torch
from pushed_box import push_clip, redrawn

from wm_nodes.core.statistics import auroc
from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.dataset.edits.clips import LabelledClip
from wm_nodes.judge.dataset.edits.recipes import edit_states
from wm_nodes.judge.evidence.motion import outline_of
from wm_nodes.judge.evidence.objects import scene_of, target_of
from wm_nodes.judge.evidence.segmentation import OBJECT
from wm_nodes.judge.evidence.sequence import (
    NUMBERS,
    READS,
    RIGHTWARD,
    SIDE_PX,
    ObjectSequence,
    TemporalNetwork,
    object_sequence,
    reading_names,
    readings,
)
from wm_nodes.judge.training.heads import UNKNOWN
from wm_nodes.judge.training.temporal_networks import FOLDS, TemporalData, cross_fit, train_temporal_network


@functools.cache
def clean() -> LabelledClip:
    return push_clip("expert")


def pictures_of(clip: LabelledClip) -> tuple[UInt8Array, UInt8Array]:
    """Pictures and drawn masks, the clean clip's first frame before them."""
    first = clean().clip
    return tuple(
        np.concatenate([of_first[:1], of_clip])
        for of_first, of_clip in ((first.frames, clip.clip.frames), (first.masks, clip.clip.masks))
    )  # type: ignore[return-value]


def sequence(pictures: UInt8Array, masks: UInt8Array) -> ObjectSequence:
    scene = scene_of(masks)
    target = target_of(masks[0], pictures[0], clean().clip.instruction)
    return object_sequence(scene, outline_of(scene, pictures), pictures, target)


def test_the_object_stays_in_the_middle_and_the_numbers_say_where_it_goes() -> None:
    found = sequence(*pictures_of(clean()))
    assert found.crops.shape == (len(clean().clip.frames) + 1, SIDE_PX, SIDE_PX, 4)
    assert found.numbers.shape == (len(found.crops), len(NUMBERS)) and np.isfinite(found.numbers).all()
    middle = found.crops[:, SIDE_PX // 2 - 1 : SIDE_PX // 2 + 1, SIDE_PX // 2 - 1 : SIDE_PX // 2 + 1, 3]
    assert (middle == OBJECT).mean() > 0.9
    share = (found.crops[0, ..., 3] == OBJECT).mean()
    assert share == pytest.approx(1 / 16, rel=0.15), "four sizes wide, the object's area is one size squared"
    place = found.numbers[:, [NUMBERS.index("place_down"), NUMBERS.index("place_right")]]
    assert np.hypot(*place[-1]) > 1 and not place[0].any()


def test_a_mirrored_clip_differs_by_the_mirror_only() -> None:
    pictures, masks = pictures_of(clean())
    found = sequence(pictures, masks)
    mirrored = sequence(pictures[:, :, ::-1].copy(), masks[:, :, ::-1].copy())
    sign = np.ones(len(NUMBERS), np.float32)
    sign[list(RIGHTWARD)] = -1
    seen = NUMBERS.index("tool_right"), NUMBERS.index("tool_step_right")
    others = [i for i in range(len(NUMBERS)) if i not in seen]  # the tool's lowest row has even and odd widths
    np.testing.assert_allclose((mirrored.numbers * sign)[:, others], found.numbers[:, others], atol=0.02)
    np.testing.assert_allclose(mirrored.numbers[:, seen], -found.numbers[:, seen], atol=0.15)
    away = np.abs(mirrored.crops[:, :, ::-1, :3].astype(float) - found.crops[..., :3])
    assert np.quantile(away, 0.99) <= 3


def test_a_clip_without_an_object_is_read_too() -> None:
    pictures = np.random.default_rng(0).integers(0, 256, (5, 32, 48, 3), np.uint8)
    found = sequence(pictures, np.zeros((5, 32, 48), np.uint8))
    assert np.isfinite(found.numbers).all() and not found.numbers[:, NUMBERS.index("seen")].any()
    reader = TemporalNetwork().eval()
    answers = readings([reader, reader], found)
    assert tuple(answers) == reading_names() and np.isfinite(list(answers.values())).all()
    assert list(answers.values()) == pytest.approx(reader.log_odds(found).tolist())
    assert readings((), found) == {}


@functools.cache
def data() -> TemporalData:
    """Clean pushes and ones with a teleport or a stretched object, each of several recordings."""
    found, answers, folds = [], [], []
    for seed in range(24):
        for recipe, question in (("", ""), ("teleport", "interaction"), ("stretch", "deformation")):
            clip = redrawn(clean(), edit_states(clean(), recipe, "fail", seed)) if recipe else clean()
            pictures, masks = pictures_of(clip)
            shift = np.random.default_rng([seed, len(recipe)]).integers(-20, 21, 3)
            found.append(sequence(np.clip(pictures + shift, 0, 255).astype(np.uint8), masks))
            answers.append([UNKNOWN if name == "geometry" else int(name != question) for name in READS])
            folds.append(seed % FOLDS)
    return TemporalData(found, np.array(answers), np.array(folds))


def test_a_reader_tells_faults_from_clean_clips_and_equal_seeds_give_equal_weights() -> None:
    chosen = np.flatnonzero(data().folds == 0)
    reader, again = (train_temporal_network(data(), chosen, epochs=30, seed=3, progress=False) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(reader.state_dict().values(), again.state_dict().values()))
    held = np.flatnonzero(data().folds == 1)
    odds = np.stack([reader.log_odds(data().sequences[i]) for i in held])
    for k in (READS.index("interaction"), READS.index("deformation")):
        fails = data().answers[held, k] == 0
        assert auroc(~fails, odds[:, k]) > 0.9, READS[k]


def test_every_training_clip_is_read_by_the_reader_that_has_not_seen_its_recording(tmp_path: Path) -> None:
    readers, held = cross_fit(tmp_path, data(), count=1, epochs=1, seed=0, progress=False)
    assert len(readers) == FOLDS
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    _, again = cross_fit(tmp_path, data(), count=1, epochs=1, seed=0, progress=False)
    np.testing.assert_array_equal(again, held)
    assert kept == {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}, "finished readers were trained again"
    for i, fold in enumerate(data().folds):
        np.testing.assert_array_equal(held[i], readers[fold].log_odds(data().sequences[i]))
    other = data().answers.copy()
    other[data().folds == 0] = 1 - other[data().folds == 0].clip(0)
    relabelled = TemporalData(data().sequences, other, data().folds)
    taught, _ = cross_fit(tmp_path, relabelled, count=1, epochs=1, seed=0, progress=False)
    same = [
        all(torch.equal(a, b) for a, b in zip(readers[k].state_dict().values(), taught[k].state_dict().values()))
        for k in range(FOLDS)
    ]
    assert same == [True, False], "the labels of fold 0 teach the other fold's reader only"


def test_of_several_readers_per_half_the_mean_counts_and_each_is_another(tmp_path: Path) -> None:
    one, _ = cross_fit(tmp_path, data(), count=1, epochs=1, seed=0, progress=False)
    readers, held = cross_fit(tmp_path, data(), count=2, epochs=1, seed=0, progress=False)
    assert len(readers) == 2 * FOLDS == len(list(tmp_path.iterdir())), "the first of each half was taken up again"
    weights = [reader.frame.weight for reader in readers]
    assert torch.equal(weights[0], one[0].frame.weight) and not torch.equal(weights[0], weights[1])
    for i in (0, 3):
        fold = data().folds[i]
        answers = [reader.log_odds(data().sequences[i]) for reader in readers[2 * fold : 2 * fold + 2]]
        np.testing.assert_allclose(held[i], np.mean(answers, 0), rtol=1e-6)


def test_recordings_that_cannot_be_divided_are_refused(tmp_path: Path) -> None:
    few = TemporalData(data().sequences, data().answers, np.zeros_like(data().folds))
    with pytest.raises(ValueError, match="recordings of one parity of seeds only: 72 clips; build larger sets"):
        cross_fit(tmp_path, few, count=1, epochs=1, seed=0, progress=False)
