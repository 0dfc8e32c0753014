"""`--from-scratch` without its graph: episodes collected in parallel, every model trained, and nothing done twice."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from wm_nodes.config.load import load_config
from wm_nodes.environments.maniskill import collection
from wm_nodes.policy_rl.pretraining import _make_tokenizer_folder, make_model
from wm_nodes.recording import read_episodes
from wm_nodes.world_model import Tokenizer, load_model_folder, load_starts


def test_the_untrained_model_beside_a_tokenizer_is_that_of_the_seed(tmp_path: Path) -> None:
    config, files = load_config("smoke"), []
    tokenizer = Tokenizer(config.tokenizer, 64, 128)
    for name in ("a", "b"):
        torch.rand(5)
        folder = _make_tokenizer_folder(config, tmp_path / name, tokenizer)
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
    assert set(story["training"]) == {"tokenizer", "action", "text", "probe"} and all(story["training"].values())
    assert story["heldout"]["episodes"] == 2 and story["made"]["command"] == "a test"
    shards = sorted((tmp_path / "data" / "train").iterdir())
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
