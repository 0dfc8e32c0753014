"""Recordings whose ground truth is withheld: nothing of what is trained on them has to do with positions."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pushing_scene import episode
from recording_samples import make_spec
from unit.policy_rl.test_recorded_robots import TINY, model_of

from wm_nodes.config.load import ConfigError, load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.types import FloatArray
from wm_nodes.policy_rl.factories import make_policy
from wm_nodes.policy_rl.model_refresh import compare_models, refresh_model
from wm_nodes.policy_rl.pretraining import load_arrays, make_model
from wm_nodes.recording import EpisodeBagWriter
from wm_nodes.recording.episode_arrays import stack_episodes
from wm_nodes.world_model import load_model_folder
from wm_nodes.world_model.validation.acceptance import accept_world_model

SPEC = make_spec(height=32, width=32, cameras=("front",))


def record(folder: Path, change: Callable[[FloatArray], FloatArray] = lambda truth: truth) -> Path:
    """A bag of the pushing scene, with another ground truth beside the same pictures, actions and flags."""
    with EpisodeBagWriter(folder, SPEC, run_id="lab", start_ns=1) as bag:
        for seed in range(24):
            one = episode(seed)
            bag.write(replace(one, ground_truth=change(one.ground_truth)))
    return folder


def settings(ground_truth: bool, **changes: object) -> RunConfig:
    torch.set_num_threads(1)
    wanted = {
        "data.ground_truth": ground_truth, "policy.inputs": "both", "tokenizer.probe_iterations": 2,
        "tokenizer.decoder_iterations": 2,
    }
    return load_config("smoke", {**TINY, **wanted, **changes})


def exchanged(truth: FloatArray) -> FloatArray:
    return np.random.default_rng(3).permuted(truth, axis=0)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("scene") / "bag")


def test_permuted_positions_give_the_same_bits_where_ground_truth_is_withheld(bag: Path, tmp_path: Path) -> None:
    other = record(tmp_path / "other", exchanged)
    seen, permuted = (
        {path.name: path.read_bytes() for path in model_of(one, settings(False), tmp_path / one.name).iterdir()}
        for one in (bag, other)
    )
    assert seen.keys() == permuted.keys() and "position_probe.safetensors" not in seen
    assert [name for name in seen if seen[name] != permuted[name]] == []

    supervised = [model_of(one, settings(True), tmp_path / f"{one.name}_true") for one in (bag, other)]
    first, second = ((folder / "tokenizer.safetensors").read_bytes() for folder in supervised)
    assert first != second and (supervised[0] / "position_probe.safetensors").is_file()


def test_neither_model_nor_policy_has_an_input_or_output_for_positions(bag: Path, tmp_path: Path) -> None:
    config = settings(False)
    models = load_model_folder(model_of(bag, config, tmp_path))
    assert models.tokenizer.probe is None and models.action.done.positions is None and models.probe is None
    assert models.spec.ground_truth_names == () and models.tasks == ("push_cube",)
    assert make_policy(config, tmp_path / "model").encoder.num_positions == 0
    with pytest.raises(ValueError, match=r"policy\.inputs is positions, and the model in .* reads none; take latents"):
        make_policy(settings(False, **{"policy.inputs": "positions"}), tmp_path / "model")
    assert "the recorded ground truth is not used (data.ground_truth)" in models.manifest["data"]["summary"]


def test_the_state_and_that_at_success_can_take_the_place_of_positions(bag: Path, tmp_path: Path) -> None:
    config = settings(False, **{"tokenizer.success_state": True})
    models = load_model_folder(model_of(bag, config, tmp_path))
    values = 2 * SPEC.tool_dim
    assert models.tokenizer.num_positions == models.action.done.num_positions == values and models.probe is None
    assert make_policy(config, tmp_path / "model").encoder.num_positions == values


def test_such_a_model_is_judged_by_pictures_also_where_the_simulator_knows_positions(bag: Path, tmp_path: Path) -> None:
    models = load_model_folder(model_of(bag, settings(False), tmp_path))
    config = settings(False, task="push_cube")
    report = accept_world_model(models, load_arrays([bag], config, models.tasks), config)
    assert "Positions were not judged: no ground truth names them." in report.notes
    (row,) = (row for row in report.criteria if row.name.startswith("varying pixels, unexplained, step"))
    assert row.outcome == "failed", "twenty iterations show no square"


def test_it_is_refreshed_without_positions_and_compared_by_its_done_signal(bag: Path, tmp_path: Path) -> None:
    config = settings(False, **{"model_refresh.refresh_iterations": 2})
    source, other = model_of(bag, config, tmp_path / "run"), record(tmp_path / "other", exchanged)
    refreshed = [refresh_model(config, source, [one], tmp_path / one.name / "model") for one in (bag, other)]
    first, second = ((folder / "action_model.safetensors").read_bytes() for folder in refreshed)
    assert first == second != (source / "action_model.safetensors").read_bytes()
    models = [load_model_folder(folder) for folder in (source, refreshed[0])]
    withheld = [replace(episode(seed), ground_truth=episode(seed).ground_truth[:, :0]) for seed in range(4)]
    decision = compare_models(*models, stack_episodes(withheld, models[0].tasks), config)
    assert [row.name for row in decision.rows] == ["done signal right"]


def test_what_collects_by_positions_refuses_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"data\.ground_truth is false.*wm collect.*wm train-model"):
        make_model(settings(False, task="push_cube"), tmp_path / "run")
