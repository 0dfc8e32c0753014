"""--device of every verb that computes: a GPU that is not there is one line, before anything begins."""

from pathlib import Path

import pytest
import torch

from wm_nodes.apps import cli
from wm_nodes.config.shipped import shipped_model

MODEL = str(shipped_model("push_cube"))


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
@pytest.mark.parametrize(
    "words",
    [
        ["train-policy", "--preset", "smoke", "--run-dir", "run"],
        ["train-policy", "--preset", "smoke", "--from-scratch", "--run-dir", "run"],
        ["train-video-model", "--preset", "smoke", "--run-dir", "run"],
        ["judge", "calibrate", MODEL, "bag"],
    ],
    ids=" ".join,
)
def test_a_missing_gpu_is_one_line_and_nothing_is_written(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main([*words, "--device", "cuda"]) == 2
    text = capsys.readouterr().err
    assert text.startswith(f"error: device is cuda, but torch {torch.__version__} sees no GPU; set device to cpu")
    assert text.count("\n") == 1
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
