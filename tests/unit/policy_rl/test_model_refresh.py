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
from wm_nodes.policy_rl.initial_policy import write_round_starts, write_starts
from wm_nodes.policy_rl.model_refresh import ModelComparison, RefreshDecision, compare_models, refresh_model
from wm_nodes.policy_rl.pretraining import load_arrays
from wm_nodes.recording import read_episodes
from wm_nodes.training.weights import save_weights
from wm_nodes.world_model import load_model_folder, load_starts
from wm_nodes.world_model.starts import load_start_seeds
from wm_nodes.world_model.validation.open_loop import episode_errors, evaluate_rollouts, imagine_episodes


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
    kept = ("tasks", "spec", "tokenizer", "world_model", "vocabulary")
    assert all(new.manifest[name] == old.manifest[name] for name in kept)
    assert new.manifest["refreshed"][0]["source_sha256"] == old.sha256
    assert old.manifest["sha256"]["action"] != new.manifest["sha256"]["action"]
    written = (folder / "manifest.json").stat().st_mtime_ns
    assert refresh_model(other, model_dir, bags[0], folder, number=1) == folder
    assert (folder / "manifest.json").stat().st_mtime_ns == written


def test_a_model_is_neither_better_nor_worse_than_itself(
    config: RunConfig, model_dir: Path, bags: tuple[list[Path], list[Path]]
) -> None:
    models = load_model_folder(model_dir)
    verdict = compare_models(models, models, load_arrays(bags[1], config), config)
    assert [row.name for row in verdict.rows] == ["tool error, cm", "object error, cm", "done signal right"]
    assert not verdict.accepted and verdict.reason == "no difference beyond chance in 3 numbers"
    assert [row.new for row in verdict.rows] == [row.old for row in verdict.rows]


def test_a_model_is_taken_when_it_is_better_in_a_number_and_worse_in_none() -> None:
    error = ModelComparison("tool error, cm", 3.0, 2.0, -1.5, -0.5, True)
    same = ModelComparison("done signal right", 0.8, 0.9, -0.1, 0.3, False)
    worse = replace(same, new=0.5, low=-0.5, high=-0.1)
    assert RefreshDecision((error, same)).accepted
    assert RefreshDecision((error, same)).reason == "better: tool error, cm 3.000 -> 2.000 (-1.500 to -0.500)"
    assert not RefreshDecision((same,)).accepted and not RefreshDecision((error, worse)).accepted
    assert RefreshDecision((error, worse)).reason == "worse: done signal right 0.800 -> 0.500 (-0.500 to -0.100)"
    assert [row["better"] for row in RefreshDecision((error, worse)).to_dict()["rows"]] == [True, False]


def test_errors_of_an_episode_are_those_at_its_own_last_step(
    config: RunConfig, model_dir: Path, bags: tuple[list[Path], list[Path]]
) -> None:
    """Cut after four steps, an episode errs as its rollout did there."""
    models, episodes = load_model_folder(model_dir), load_arrays(bags[1], config)
    cut = replace(episodes, lengths=np.full(len(episodes), 4))
    found = episode_errors(models.tokenizer, models.action, cut, config.task, threshold=0.7, probe=models.probe)
    imagined = imagine_episodes(models.tokenizer, models.action, episodes)
    means = evaluate_rollouts(models.tokenizer, imagined, episodes, probe=models.probe)
    assert found["tool_cm"].mean() == pytest.approx(means["tool_rollout_cm_h04"], rel=1e-4)
    assert found["object_cm"].mean() == pytest.approx(means["object_rollout_cm_h04"], rel=1e-4)
    whole = episode_errors(models.tokenizer, models.action, episodes, config.task, threshold=0.7, probe=models.probe)
    assert whole["done_right"].mean() == pytest.approx(means[f"done_{config.task}_agreement"])


def test_the_next_round_also_imagines_from_frames_of_the_policys_own_episodes(
    config: RunConfig, bags: tuple[list[Path], list[Path]], tmp_path: Path
) -> None:
    write_starts(bags[1], tmp_path / "first.safetensors")
    write_round_starts(config, tmp_path / "first.safetensors", bags[0], tmp_path / "round.safetensors")
    first, joined = (load_starts(tmp_path / f"{name}.safetensors", config.task) for name in ("first", "round"))
    assert len(first[0]) == 2 and len(joined[0]) == 5
    np.testing.assert_array_equal(joined[0][:2], first[0])
    own = {frame.tobytes() for bag in bags[0] for episode in read_episodes(bag) for frame in episode.images}
    assert all(frame.tobytes() in own for frame in joined[0][2:])
    with pytest.raises(ValueError, match="no reset seeds"):
        load_start_seeds(tmp_path / "round.safetensors")


def test_starts_are_of_the_newest_policys_episodes_first(
    config: RunConfig, bags: tuple[list[Path], list[Path]], tmp_path: Path
) -> None:
    for number, part in enumerate((bags[1], bags[0]), 1):
        folder = model_refresh.round_folder(tmp_path, number) / "bags" / "train"
        folder.mkdir(parents=True)
        for bag in part:
            (folder / bag.name).symlink_to(bag)
    few = config.with_values(model_refresh=config.model_refresh.with_values(own_starts=3))
    write_starts(bags[1], tmp_path / "first")
    write_round_starts(few, tmp_path / "first", model_refresh.own_episodes(tmp_path, 2), tmp_path / "round")
    newest = {frame.tobytes() for bag in bags[0] for episode in read_episodes(bag) for frame in episode.images}
    images, _ = load_starts(tmp_path / "round", config.task)
    assert [image.tobytes() in newest for image in images] == [False] * 2 + [True] * 3


def test_quantised_models_are_refused_with_the_remedy(config: RunConfig, tmp_path: Path) -> None:
    quantised = config.model_copy(update={"tokenizer": config.tokenizer.model_copy(update={"kind": "lfq"})})
    folder = make_model_folder(tmp_path / "model", quantised)
    with pytest.raises(ValueError, match=r"tokenizer\.kind lfq.*num_rounds to 1"):
        refresh_model(quantised, folder, [], tmp_path / "new")
