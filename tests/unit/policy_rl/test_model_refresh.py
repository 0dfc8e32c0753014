"""Online rounds without a graph: a policy's episodes from the simulator, a refreshed model, which one is kept."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from model_folders import make_model_folder

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.policy_rl import model_refresh
from wm_nodes.policy_rl.factories import make_policy
from wm_nodes.policy_rl.model_refresh import ModelComparison, RefreshDecision, compare_models, is_worse, refresh_model
from wm_nodes.policy_rl.pretraining import load_arrays
from wm_nodes.recording import read_episodes
from wm_nodes.training.weights import save_weights
from wm_nodes.world_model import load_model_folder


@pytest.fixture(scope="module")
def config() -> RunConfig:
    sizes = {"model_refresh.episodes_per_round": 3, "model_refresh.heldout_episodes": 2}
    return load_config("smoke", {"data.num_workers": 1, **sizes})


@pytest.fixture(scope="module")
def model_dir(config: RunConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_model_folder(tmp_path_factory.mktemp("model"), config)


@pytest.fixture(scope="module")
def bags(config: RunConfig, model_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], list[Path]]:
    folder = tmp_path_factory.mktemp("round")
    weights = folder / "policy.safetensors"
    policy = make_policy(config, model_dir)
    save_weights(policy, weights, {"tokenizer_sha256": policy.encoder.sha256})
    return model_refresh.collect_round(config, model_dir, weights, folder, 2)


def test_a_round_collects_noisy_whole_episodes_on_seeds_of_its_own(bags: tuple[list[Path], list[Path]]) -> None:
    train, heldout = ([episode for bag in part for episode in read_episodes(bag)] for part in bags)
    assert [episode.seed for episode in train] == [805_000, 805_001, 805_002]
    assert [episode.seed for episode in heldout] == [905_000, 905_001]
    assert {(episode.num_steps, episode.policy_version, episode.behaviour) for episode in train} == {(16, 2, "policy")}
    spread = np.std(np.concatenate([episode.actions for episode in train]), 0)
    assert np.allclose(spread, math.exp(-1.2), rtol=0.4)  # the untrained policy's mean is nearly zero


def test_a_refresh_changes_the_action_model_and_nothing_else(
    config: RunConfig, model_dir: Path, bags: tuple[list[Path], list[Path]], tmp_path: Path
) -> None:
    other = config.model_copy(
        update={"world_model": config.world_model.model_copy(update={"num_done_heads": 7, "batch_size": 2})}
    )
    folder = refresh_model(other, model_dir, bags[0], tmp_path / "model", number=1)
    old, new = load_model_folder(model_dir), load_model_folder(folder)
    assert new.tokenizer_sha256 == old.tokenizer_sha256 and new.sha256 != old.sha256
    assert (folder / "tokenizer.safetensors").read_bytes() == (model_dir / "tokenizer.safetensors").read_bytes()
    kept = ("tasks", "simulation", "tokenizer", "world_model", "vocabulary")
    assert all(new.manifest[name] == old.manifest[name] for name in kept)
    assert new.manifest["refreshed"][0]["source_sha256"] == old.sha256
    assert old.manifest["sha256"]["action"] != new.manifest["sha256"]["action"]
    written = (folder / "manifest.json").stat().st_mtime_ns
    assert refresh_model(other, model_dir, bags[0], folder, number=1) == folder
    assert (folder / "manifest.json").stat().st_mtime_ns == written


def test_a_model_is_no_worse_than_itself(
    config: RunConfig, model_dir: Path, bags: tuple[list[Path], list[Path]]
) -> None:
    models = load_model_folder(model_dir)
    verdict = compare_models(models, models, {"policy": load_arrays(bags[1], config)}, config)
    assert verdict.accepted and len(verdict.rows) == 4
    assert verdict.to_dict()["rows"][0]["old"] == pytest.approx(verdict.rows[0].new)


def test_an_undefined_number_is_worse_than_any_other() -> None:
    nan = math.nan
    assert is_worse(0.5, nan, 0.1, error=True) and is_worse(0.5, nan, 0.1, error=False)
    assert not is_worse(nan, nan, 0.1, error=True) and not is_worse(nan, 0.1, 0.1, error=False)
    assert is_worse(0.5, 0.56, 0.1, error=True) and not is_worse(0.5, 0.54, 0.1, error=True)
    assert is_worse(0.5, 0.39, 0.1, error=False) and not is_worse(0.5, 0.41, 0.1, error=False)


def test_a_verdict_names_what_got_worse() -> None:
    good = ModelComparison("policy", "done recall", 0.5, 0.6, False)
    bad = replace(good, name="done precision", new=math.nan, worse=True)
    assert RefreshDecision((good,)).accepted
    assert not RefreshDecision((good, bad)).accepted
    assert "done precision on policy episodes 0.500 -> undefined" in RefreshDecision((good, bad)).reason
    assert RefreshDecision((good, bad)).to_dict()["rows"][1]["new"] is None


def test_quantised_models_are_refused_with_the_remedy(config: RunConfig, tmp_path: Path) -> None:
    quantised = config.model_copy(update={"tokenizer": config.tokenizer.model_copy(update={"kind": "lfq"})})
    folder = make_model_folder(tmp_path / "model", quantised)
    with pytest.raises(ValueError, match=r"tokenizer\.kind lfq.*--rounds 1"):
        refresh_model(quantised, folder, [], tmp_path / "new")
