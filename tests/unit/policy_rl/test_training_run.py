"""The checkpoint of loop 1: what saving it writes, what it removes, and what it leaves alone."""

import json
import os
import re
from pathlib import Path

import pytest
from rl_toys import toy_policy, toy_ppo

from wm_nodes.policy_rl.ppo import PpoLearner
from wm_nodes.policy_rl.training_run import POLICY_FILES, PolicyTraining


def start(run_dir: Path, *, resume: bool = True) -> PolicyTraining:
    policy = toy_policy()
    learner = PpoLearner(policy, toy_ppo(), seed=0)
    return PolicyTraining(policy, learner, run_dir, resume=resume, keep_versions=20, metadata={})


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def advance(training: PolicyTraining) -> None:
    training.progress.updates += 1
    training.progress.version += 1


def test_a_checkpoint_replaces_what_the_one_before_it_names_and_nothing_else(tmp_path: Path) -> None:
    training = start(tmp_path)
    beside = tmp_path / "checkpoints"
    kept = {"learner_best.safetensors", "learner_000000.txt", "learner_9.learner", "notes.json"}
    for name in kept:
        (beside / name).write_bytes(b"mine")
    advance(training)
    training.save()
    assert {path.name for path in beside.iterdir()} == kept | {
        "learner.json", "learner_000001.safetensors", "learner_000001.learner"
    }
    assert all((beside / name).read_bytes() == b"mine" for name in kept)
    assert POLICY_FILES.versions(tmp_path) == [1, 2]
    assert start(tmp_path).progress.updates == 1


def test_files_that_a_kill_left_beside_the_runs_own_checkpoint_do_not_stop_it(tmp_path: Path) -> None:
    start(tmp_path)
    for kind in ("safetensors", "learner"):  # written, but the kill came before the checkpoint that names them
        (tmp_path / "checkpoints" / f"learner_000001.{kind}").write_bytes(b"half")
    training = start(tmp_path)
    advance(training)
    training.save()
    assert start(tmp_path).progress.updates == 1


def test_a_checkpoint_of_another_name_is_written_beside_and_again_in_its_place(tmp_path: Path) -> None:
    training = start(tmp_path)
    before = contents(tmp_path)
    mine = tmp_path / "mine" / "best.json"
    training.save_checkpoint(mine)
    advance(training)
    training.save_checkpoint(mine)
    assert sorted(path.name for path in mine.parent.iterdir()) == [
        "best.json", "best_000001.learner", "best_000001.safetensors"
    ]
    assert {name: data for name, data in contents(tmp_path).items() if not name.startswith("mine/")} == before


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("policies/policy.json", "policy_000001.safetensors would be overwritten; take another name than policy.json"),
        ("mine/taken.json", "is there and is no checkpoint of a learner"),
        ("mine/other.json", "it names files of another checkpoint"),
        ("mine/list.json", "is there and is no checkpoint"),
        ("mine/fifo.json", "is no regular file"),
        ("mine/folder.json", "is no regular file"),
        ("mine/link.json", "is there and is no checkpoint"),
        ("config.yaml", "is there and is no checkpoint"),
        ("metrics.jsonl", "must end in .json"),
        ("mine/state.json", "state_000001.learner would be overwritten"),
    ],
)
def test_a_file_that_is_no_checkpoint_is_never_replaced(tmp_path: Path, name: str, words: str) -> None:
    training = start(tmp_path)
    advance(training)
    (tmp_path / "config.yaml").write_text("task: reach\n")
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "taken.json").write_text(json.dumps({"weights": "a", "learner": "b"}))
    (mine / "list.json").write_text("[1]")
    (mine / "state_000001.learner").write_bytes(b"mine")
    (mine / "folder.json").mkdir()
    os.mkfifo(mine / "fifo.json")
    (mine / "link.json").symlink_to("nowhere")
    checkpoint = json.loads((tmp_path / "checkpoints" / "learner.json").read_text())
    (mine / "other.json").write_text(json.dumps(checkpoint | {"weights": "../../config.yaml"}))
    before = contents(tmp_path)
    with pytest.raises(ValueError, match=words.replace(".", r"\.")) as refused:
        training.save_checkpoint(tmp_path / name)
    assert len(str(refused.value).splitlines()) == 1
    assert contents(tmp_path) == before


def test_a_run_that_begins_anew_replaces_the_old_ones_checkpoint_and_no_other_file(tmp_path: Path) -> None:
    training = start(tmp_path)
    advance(training)
    training.save()
    start(tmp_path, resume=False)
    assert sorted(path.name for path in (tmp_path / "checkpoints").iterdir()) == [
        "learner.json", "learner_000000.learner", "learner_000000.safetensors"
    ]
    (tmp_path / "checkpoints" / "learner.json").write_text("mine")
    with pytest.raises(ValueError, match="is no checkpoint of a learner"):
        start(tmp_path, resume=False)


@pytest.mark.parametrize("suffix", [".json", "_000001.safetensors", "_000001.learner"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.98])
def test_a_file_cut_short_is_named_with_the_remedy(suffix: str, share: float, tmp_path: Path) -> None:
    training = start(tmp_path)
    advance(training)
    training.save()
    file = tmp_path / "checkpoints" / f"learner{suffix}"
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ValueError, match=re.escape(str(file))) as refused:
        start(tmp_path)
    text = str(refused.value)
    assert "put a copy of it back, or begin anew" in text and "configuration" not in text and "\n" not in text
