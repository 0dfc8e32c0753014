"""The command that trains the embedded judge: what it keeps, what it refuses. On a toy set."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evidence_table import EVIDENCE
from pushed_box import push_clip, redrawn

from wm_nodes.apps.cli import main
from wm_nodes.judge.dataset.edits.clips import LabelledClip
from wm_nodes.judge.dataset.edits.generator import children
from wm_nodes.judge.dataset.edits.manifest import Division, manifest_of, to_bytes
from wm_nodes.judge.dataset.set_files import MANIFEST, clip_path, to_file
from wm_nodes.judge.evidence.segmentation import Segmenter
from wm_nodes.judge.training.data import load_sets, rows_of, set_clips
from wm_nodes.judge.training.segmenter import has_true_masks, overlaps, segmentation_data, train_segmenter
from wm_nodes.judge.training.train import collect_evidence

SHORT = ["--segmenter-steps", "2", "--trees", "2"]


def write_set(folder: Path, division: Division) -> Path:
    """Four episodes with a few edits each."""
    clips: list[LabelledClip] = []
    for seed in range(4):
        root = push_clip("expert", seed)
        clips += [root, *children(root, 0, redrawn, names=("dark", "object_vanish"))]
    for clip in clips:
        path = clip_path(folder, clip.sha256)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(to_file(clip))
    (folder / MANIFEST).write_bytes(to_bytes(manifest_of(clips, division)))
    return folder


@pytest.fixture(scope="module")
def toy_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("set"), Division(validation=0.4, test=0.0))


def test_a_set_without_a_fault_of_some_kind_is_refused_and_finished_stages_are_kept(
    toy_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train-judge", str(tmp_path), str(toy_set), *SHORT]) == 2
    assert "error: training clips of clarity are all above level 0; build larger sets" in capsys.readouterr().err
    kept = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert {"segmenter.safetensors", "segmenter.json"} < kept.keys()
    assert len(kept) == 8, "two files of each part, and two readers"
    with np.load(next(tmp_path.glob("evidence-*.npz")), allow_pickle=False) as arrays:
        assert set(arrays["names"]) == set(EVIDENCE) and np.isfinite(arrays["values"]).all()
    assert main(["train-judge", str(tmp_path), str(toy_set), *SHORT]) == 2
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == kept


def test_what_cannot_be_trained_or_measured_is_named(
    toy_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def error(*arguments: str) -> str:
        assert main(["train-judge", *arguments, *SHORT]) == 2
        return capsys.readouterr().err

    assert "holds no judge.json" in error(str(tmp_path), str(toy_set), "--measure", "test")
    assert "No such file" in error(str(tmp_path), str(tmp_path / "none"))
    other = write_set(tmp_path / "other", Division(validation=0.3, test=0.0))
    assert "use sets of one division" in error(str(tmp_path), str(toy_set), str(other))
    tests = write_set(tmp_path / "tests", Division(scenes=("gravel",)))
    assert "no clip has masks that show what is seen" in error(str(tmp_path / "out"), str(tests))


def test_evidence_is_kept_when_labels_change_and_made_again_for_other_clips(toy_set: Path, tmp_path: Path) -> None:
    (folder, manifest), model = load_sets([toy_set])[0], Segmenter().eval()
    rows = rows_of(manifest, ["validation"])
    assert len(collect_evidence(tmp_path, [(folder, manifest)], "validation", model, progress=False).rows) == len(rows)
    kept = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    worse = {row.sha256: replace(row, labels=replace(row.labels, tc_level=0)) for row in rows}
    relabelled = replace(manifest, rows=tuple(worse.get(row.sha256, row) for row in manifest.rows))
    again = collect_evidence(tmp_path, [(folder, relabelled)], "validation", model, progress=False)
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == kept
    assert list(again.rows) == list(worse.values())
    fewer = replace(manifest, rows=tuple(row for row in manifest.rows if row is not rows[0]))
    assert len(collect_evidence(tmp_path, [(folder, fewer)], "validation", model, progress=False).rows) == len(rows) - 1
    assert len(list(tmp_path.iterdir())) == 2 * len(kept)


def test_the_segmenter_learns_the_toy_and_leaves_out_masks_of_what_is_not_there(toy_set: Path) -> None:
    sets = load_sets([toy_set])
    clips = [*set_clips(sets, ["train", "validation"])]
    vanished = [clip for clip in clips if clip.row.edits and clip.row.labels.components.get("objective") is False]
    assert vanished and not any(has_true_masks(clip.row) for clip in vanished)
    images, masks = segmentation_data(clips, 0)
    assert len(images) == 4 * (len(clips) - len(vanished)) == len(masks)
    images, masks = images[:, 32:72, 16:56], masks[:, 32:72, 16:56]
    model = train_segmenter(images, masks, num_steps=100, seed=0, progress=False)
    again = train_segmenter(images, masks, num_steps=3, seed=0, progress=False)
    same = train_segmenter(images, masks, num_steps=3, seed=0, progress=False)
    assert overlaps(model, images, masks)["robot"] > 0.5 > overlaps(again, images, masks)["robot"]
    assert all((a == b).all() for a, b in zip(again.state_dict().values(), same.state_dict().values()))
