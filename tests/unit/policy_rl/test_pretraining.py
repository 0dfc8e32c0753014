"""`--from-scratch` without its graph: episodes collected in parallel, every model trained, and nothing done twice."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from wm_nodes.config.load import load_config
from wm_nodes.config.object_state import READER
from wm_nodes.core.device import DeviceError
from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.environments import collection
from wm_nodes.environments.collection import SCATTERED
from wm_nodes.environments.object_reader import load_object_reader
from wm_nodes.environments.registry import configured_spec
from wm_nodes.policy_rl import pretraining
from wm_nodes.policy_rl.pretraining import _make_tokenizer_folder, make_model
from wm_nodes.recording import read_episodes
from wm_nodes.world_model import Tokenizer, load_model_folder, load_starts
from wm_nodes.world_model.folder import save_refreshed_folder


def test_the_untrained_model_beside_a_tokenizer_is_that_of_the_seed(tmp_path: Path) -> None:
    config, files = load_config("smoke"), []
    tokenizer = Tokenizer(config.tokenizer, 64, 128)
    for name in ("a", "b"):
        torch.rand(5)
        folder = _make_tokenizer_folder(config, tmp_path / name, tokenizer, configured_spec(config), torch.zeros(2, 3))
        files.append((folder / "action_model.safetensors").read_bytes())
    assert files[0] == files[1]


@pytest.mark.slow
@pytest.mark.rendering
def test_a_model_from_scratch_is_collected_in_parallel_and_resumed_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collection, "EPISODES_PER_SHARD", 2)
    config = load_config("smoke", {
        "task": "pull_cube", "data.num_episodes": 4, "data.num_heldout": 2, "data.policy_episodes": 2,
        "data.behaviours": {"expert": 1.0}, "data.num_workers": 2, "tokenizer.num_iterations": 4,
        "world_model.num_iterations": 4, "sft.num_iterations": 2,
    })
    folder = make_model(config, tmp_path, command="a test")
    models = load_model_folder(folder)
    assert models.tasks == ("pull_cube",) and models.text is not None
    assert len(load_starts(folder / "starts.safetensors")[0]) == 4
    story = json.loads((folder / "manifest.json").read_text())
    assert (story["data"]["episodes"], story["data"]["policy_episodes"]) == (6, 2)
    trained = {"tokenizer", "decoder", "action", "text", "probe"}
    assert set(story["training"]) == trained and all(story["training"].values())
    assert (folder / "decoder.safetensors").is_file() and "psnr_shuffled_drop_db_h04" in story["heldout"]
    assert {story[name]["episodes"] for name in ("heldout", "heldout_extreme")} == {2}
    assert story["made"]["command"] == "a test"
    shards = sorted((tmp_path / "data" / "train").glob("shard_*"))
    assert (tmp_path / "data" / "train" / "index.csv").is_file()
    assert [shard.name for shard in shards] == ["shard_00000000", "shard_00000002"]

    episodes = [episode for shard in shards for episode in read_episodes(shard)]
    assert [episode.seed for episode in episodes] == [0, 1, 2, 3]
    assert all(episode.behaviour == "expert" and episode.success.any() for episode in episodes)

    files = {path.name: path.read_bytes() for path in folder.glob("*.safetensors")}
    kept = {path: path.stat().st_mtime_ns for path in shards[0].iterdir()}
    for lost in (folder, shards[1]):  # as if stopped while it collected
        shutil.rmtree(lost)
    make_model(config, tmp_path)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept and shards[1].is_dir()
    assert {path.name: path.read_bytes() for path in folder.glob("*.safetensors")} == files


@pytest.mark.slow
@pytest.mark.rendering
def test_one_model_is_made_of_the_episodes_of_several_tasks_and_measured_on_every_split(tmp_path: Path) -> None:
    small = {"data.num_episodes": 2, "data.num_heldout": 1, "tokenizer.num_iterations": 2, "data.num_workers": 1,
             "data.num_scattered": 1, "tokenizer.probe_iterations": 2, "world_model.object_reader_iterations": 2,
             "world_model.state_model_iterations": 2}
    config = load_config("smoke", {
        "task": "push", "data.behaviours": {"expert": 1.0}, "world_model.num_iterations": 2,
        "simulation.max_episode_steps": 12, **small,
    })
    folder = make_model(config, tmp_path)
    models, story = load_model_folder(folder), json.loads((folder / "manifest.json").read_text())
    assert models.tasks == ("move_to_aim", "pick_place", "pull", "push", "reach_object")
    assert story["data"]["episodes"] == 10 and story["data"]["policy_episodes"] == 0
    reader = load_object_reader(folder / READER, models.spec)
    assert reader.views == 2 and story["training"]["object_reader"]["error_m"] > 0
    assert models.spec.measured and models.action.state_model is not None
    refreshed = save_refreshed_folder(tmp_path / "refreshed", folder, models.action, {})
    assert (refreshed / READER).read_bytes() == (folder / READER).read_bytes()
    (refreshed / READER).write_bytes(b"")
    with pytest.raises(ModelFolderError, match="is not the file its manifest names"):
        load_model_folder(refreshed)
    for split in ("heldout", "heldout_ood_object", "heldout_ood_combo"):
        assert {task: values["episodes"] for task, values in story[split].items()} == dict.fromkeys(models.tasks, 1)
        assert "done_push_auc" in story[split]["push"] and "done_pull_auc" not in story[split]["push"]
    recorded = {path.parent.name: path for path in (tmp_path / "data" / "train").glob("*/shard_*")}
    behaviours = {task: {e.behaviour for e in read_episodes(bag)} for task, bag in recorded.items()}
    assert set(recorded) == set(models.tasks) and behaviours["push"] == {"expert"} != behaviours["pick_place"]
    scattered = [one for bag in (tmp_path / "data" / SCATTERED).glob("*/shard_*") for one in read_episodes(bag)]
    assert (story["data"]["scattered_episodes"], story["data"]["training_seeds"]) == (5, [[0, 2]])
    assert {(one.task, one.behaviour, one.seed) for one in scattered} == {(task, SCATTERED, 2) for task in models.tasks}
    assert len(load_starts(folder / "starts.safetensors")[0]) == 10
    assert len(load_starts(folder / "starts.safetensors", "push")[0]) == 2
    with pytest.raises(ValueError, match="has starts of move_to_aim, pick_place, pull, push, reach_object, none of"):
        load_starts(folder / "starts.safetensors", "reach")


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_gpu_that_is_not_there_is_found_out_before_anything_is_collected(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="device is cuda:0, but torch"):
        make_model(load_config("smoke", {"device": "cuda:0"}), tmp_path)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("training", "section"), [("train_tokenizer", "tokenizer"), ("train_action_model", "world_model")]
)
def test_too_little_memory_in_training_names_the_batch_of_the_model(
    training: str, section: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = load_config("smoke", {"data.policy_episodes": 0, f"{section}.batch_size": 48})

    def full(*arguments: object, **more: object) -> None:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory.\nTried to allocate 20.00 GiB.")

    skipped = {
        "collect_scripted": {"push_cube": ["bag"]}, "read_spec": configured_spec(config), "load_arrays": None,
        "train_tokenizer": (None, {}), "train_position_probe": (None, {}), "tokenise_episodes": None,
        "train_state_probe": {"loss": 0.0},
    }
    for name, answer in skipped.items():
        monkeypatch.setattr(pretraining, name, lambda *arguments, answer=answer: answer)
    monkeypatch.setattr(pretraining, training, full)
    with pytest.raises(DeviceError, match=rf"memory of cpu is too small; lower {section}\.batch_size from 48 to 24"):
        make_model(config, tmp_path)
