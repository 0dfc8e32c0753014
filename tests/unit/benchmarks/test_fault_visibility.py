"""Pixels that a physical fault changes, on the toy set."""

from pathlib import Path

import numpy as np
import pytest
from pushed_box import push_clip, redrawn

from benchmarks.judge.fault_visibility import changed_px
from wm_nodes.apps.cli import main
from wm_nodes.judge.dataset.edits.generator import children
from wm_nodes.judge.dataset.edits.manifest import Division, manifest_of, to_bytes
from wm_nodes.judge.dataset.set_files import MANIFEST, clip_path, to_file

DIVISION = Division(validation=0.0, test=0.0)


def test_a_fault_is_compared_with_its_own_recording_and_only_faults_of_states_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = push_clip("expert", 0)
    clips = [root, *children(root, 0, redrawn, names=("teleport", "dark"))]
    for clip in clips:
        path = clip_path(tmp_path, clip.sha256)
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(to_file(clip))
    manifest = manifest_of(clips, DIVISION)
    (tmp_path / MANIFEST).write_bytes(to_bytes(manifest))
    jumped = next(clip for clip in clips if clip.recipe == "teleport" and clip.severity == "fail")
    row = next(row for row in manifest.rows if row.sha256 == jumped.sha256)
    differs = np.abs(jumped.clip.frames.astype(int) - root.clip.frames).max(-1) > 8
    assert changed_px(tmp_path, row) == max(frame.sum() for frame in differs) > 50
    assert main(["benchmark", "judge", "fault-visibility", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    kinds = [line.split()[:3] for line in lines[2:]]
    assert kinds == [["fail", "teleport", "1"], ["mild", "teleport", "1"]], "dark is no fault of states"
    assert lines[2].split()[3] == str(changed_px(tmp_path, row)) and lines[2].split()[-1] == "0"
    assert main(["benchmark", "judge", "fault-visibility", str(tmp_path), "--part", "test"]) == 2
    assert "no test clip has one edit of its states" in capsys.readouterr().err
