"""Claims A and B on clips of recorded contexts: the commands, on episodes of noise and the shipped video model."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from recording_samples import make_episode, make_spec

from benchmarks.video_rl import recorded
from benchmarks.video_rl.recorded import CODEC, COPY, ENLARGED, MODEL
from benchmarks.video_rl.sources import TASK
from wm_nodes.apps.cli import main
from wm_nodes.config.shipped import shipped_model
from wm_nodes.recording import EpisodeBagWriter
from wm_nodes.video_model.folder import load_video_folder, save_video_folder

STEPS = 4
CPS, DYNDIFF = "CPS 0.4", "DynDiff 0.6 gated, rms"


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Contexts to train on and held-out ones: five episodes each, of noise above a row that stands still."""
    folder, spec = tmp_path_factory.mktemp("clips"), make_spec(height=64, width=128)
    paths = folder / "contexts", folder / "heldout"
    for first, path in zip((0, 5), paths, strict=True):
        with EpisodeBagWriter(path, spec, run_id=path.name, start_ns=1) as bag:
            for index in range(first, first + 5):
                episode = make_episode(spec, index, STEPS)
                episode.images[:, -1] = 0
                bag.write(replace(episode, ground_truth=np.full_like(episode.ground_truth, 0.1)))
    return paths


def test_clips_of_one_noise_by_ode_are_one_clip_and_arms_are_paired_within_their_regime(
    bags: tuple[Path, Path], tmp_path: Path
) -> None:
    path = tmp_path / "clips.json"
    samplers = ["--samplers", "ODE", "CPS 0.2", "DynDiff 0.2 sparse, rms"]
    size = ["--contexts", "2", "--group-size", "2"]
    call = ["clips", "--context-bags", str(bags[1]), *size, *samplers, "--json", str(path)]
    assert main(["benchmark", *call]) == 0
    found = json.loads(path.read_text())
    rows = {(row["sampler"], row["shared_noise"]): row for row in found["rows"]}
    assert len(rows) == 6 and all(len(row["diversity"]) == len(row["tracking"]) == 2 for row in rows.values())
    assert rows["ODE", True]["diversity"] == pytest.approx([0, 0], abs=1e-6)
    assert rows["ODE", True]["reward_std"] == [0, 0] and rows["ODE", True]["object_spread_cm"] == [0, 0]
    assert all(min(row["diversity"]) > 1e-4 for key, row in rows.items() if key != ("ODE", True))
    pairs = [(row["sampler"], row["base"], row["shared_noise"]) for row in found["comparisons"]]
    assert pairs == [("DynDiff 0.2 sparse, rms", "CPS 0.2", shared) for shared in (False, True)]
    noise = [row["noise_share"] for row in found["comparisons"]]
    assert all(sampler == pytest.approx(base, rel=0.02) for sampler, base in noise), "not at one noise budget"


@pytest.fixture(scope="module")
def learning(bags: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], Path]:
    """A call of clip-learning without its number of buffers, and its file."""
    path = tmp_path_factory.mktemp("clip_learning") / "found.json"
    given = ["--context-bags", str(bags[0]), "--heldout-bags", str(bags[1]), "--eval-contexts", "3"]
    call = ["clip-learning", *given, "--seeds", "0", "1", "--samplers", CPS, DYNDIFF, "--json", str(path)]
    assert main(["benchmark", *call, "--iterations", "1"]) == 0
    return call, path


def test_arms_train_from_the_same_start_with_the_same_calls_and_end_apart(learning: tuple[list[str], Path]) -> None:
    _, path = learning
    found = json.loads(path.read_text())
    rows: dict[tuple[str, int], dict[str, Any]] = {(row["sampler"], row["seed"]): row for row in found["rows"]}
    assert set(rows) == {(sampler, seed) for sampler in (CPS, DYNDIFF) for seed in (0, 1)}
    for seed in (0, 1):
        cps, dyndiff = rows[CPS, seed], rows[DYNDIFF, seed]
        assert cps["before"] == dyndiff["before"] and cps["after"] != dyndiff["after"]
        assert cps["after"]["psnr_db"] != cps["before"]["psnr_db"] and len(cps["after"]["psnr_db"]) == 3
        assert cps["evaluations"][-1]["psnr_db"] == pytest.approx(np.mean(cps["after"]["psnr_db"]), rel=1e-4)
        assert cps["buffers"]["kept"] == dyndiff["buffers"]["kept"]
    assert rows[CPS, 0]["before"] != rows[CPS, 1]["before"], "seeds have their own evaluation noise"
    settings = {sampler["name"]: sampler for sampler in found["samplers"]}
    assert settings[CPS]["grpo"] == settings[DYNDIFF]["grpo"]
    steps = {name: sampler["rollout"].pop("sampler") for name, sampler in settings.items()}
    assert settings[CPS]["rollout"] == settings[DYNDIFF]["rollout"] and steps[CPS] != steps[DYNDIFF]
    assert [(row["sampler"], row["base"]) for row in found["comparisons"]] == [(DYNDIFF, CPS)]
    assert set(found["sha256"]) == {"codec.safetensors", "network.safetensors"}


def test_trainings_in_the_file_are_not_made_again_and_another_plan_is_refused(
    learning: tuple[list[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    call, path = learning
    rows = json.loads(path.read_text())["rows"]
    assert main(["benchmark", *call, "--iterations", "1"]) == 0
    assert json.loads(path.read_text())["rows"] == rows, "their seconds would differ"
    assert main(["benchmark", *call, "--iterations", "2"]) == 2
    assert "take another file" in " ".join(capsys.readouterr().err.split())


def test_trainings_by_another_setup_or_of_another_base_are_refused_and_those_that_do_not_say_are_too(
    learning: tuple[list[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    call, path = learning
    call = ["benchmark", *call, "--iterations", "1"]

    def refused(*more: str) -> str:
        held = path.read_bytes()
        assert main([*call, *more]) == 2 and path.read_bytes() == held
        return " ".join(capsys.readouterr().err.split())

    assert "by another base (recordings.heldout [" in refused("--heldout-bags", call[call.index("--context-bags") + 1])
    samplers, folder = recorded.clip_learning_samplers(), load_video_folder(shipped_model(TASK) / "video_model")
    quicker = [replace(one, grpo=one.grpo.with_values(learning_rate=1e-3)) for one in samplers]
    with monkeypatch.context() as patch:
        patch.setattr(recorded, "clip_learning_samplers", lambda: quicker)
        words = f"holds {CPS} by another setup (grpo.learning_rate 0.0002, this call has 0.001); take another file"
        assert words in refused()
    with torch.no_grad():
        next(folder.network.parameters()).add_(1.0)
    save_video_folder(tmp_path / "other", folder.codec, folder.network, folder.clip, {"task": TASK})
    found = refused("--video-model", str(tmp_path / "other"))
    assert f"holds {CPS} by another base (sha256.network.safetensors " in found
    found = refused("--video-model", str(tmp_path / "other"), "--samplers", "CPS 0.6")
    assert f"holds {CPS} by another base" in found
    held = json.loads(path.read_text())
    old = tmp_path / "old.json"
    rows = [{name: value for name, value in row.items() if name not in ("setup", "base")} for row in held["rows"]]
    old.write_text(json.dumps({**held, "rows": rows}))
    assert "another setup (not recorded); take another file" in refused("--json", str(old))


def test_sizes_are_shown_beside_the_own_one_enlarged_and_the_own_one_is_the_same_there(tmp_path: Path) -> None:
    paths = []
    for side in (64, 96):
        paths.append(tmp_path / f"side_{side}")
        spec = make_spec(height=side, width=2 * side)
        with EpisodeBagWriter(paths[-1], spec, run_id="sizes", start_ns=1) as bag:
            episode = make_episode(spec, 0, STEPS)
            bag.write(replace(episode, ground_truth=np.full_like(episode.ground_truth, 0.1)))
    path = tmp_path / "found.json"
    call = ["resolution", "--context-bags", *map(str, paths), "--contexts", "1", "--json", str(path)]
    assert main(["benchmark", *call]) == 0
    rows = {(row["side_px"], row["shown"]): row for row in json.loads(path.read_text())["rows"]}
    assert set(rows) == {(side, shown) for side in (64, 96) for shown in (MODEL, ENLARGED, CODEC, COPY)}
    assert rows[64, MODEL]["psnr_db"] == rows[64, ENLARGED]["psnr_db"]
    assert rows[96, MODEL]["psnr_db"] != rows[96, ENLARGED]["psnr_db"]
    assert rows[96, COPY]["psnr_db"] != rows[96, CODEC]["psnr_db"]
