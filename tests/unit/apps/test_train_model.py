"""wm train-model: a stranger's bag becomes a model that is judged, with what it says on the way."""

import json
import os
import shutil
from pathlib import Path

import pytest
from unit.policy_rl.test_recorded_robots import NO_STATE, TINY, record

from wm_nodes.apps.cli import main
from wm_nodes.config.tasks import get_task
from wm_nodes.world_model import load_model_folder

SMALL = [word for name, value in TINY.items() if name != "task" for word in (f"--{name}", json.dumps(value))]


def train(*words: object) -> int:
    return main(["train-model", "--preset", "smoke", *SMALL, *map(str, words)])


def said(capsys: pytest.CaptureFixture[str]) -> tuple[str, str]:
    out, err = capsys.readouterr()
    return " ".join(out.split()), err


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("lab") / "bag", 16)


def test_a_model_is_trained_judged_and_kept_and_the_folder_alone_goes_on(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    limits = "--acceptance.done_precision", 0, "--acceptance.done_recall", 0, "--acceptance.feature_error_ratio", 99
    code = train("--bags", bag, "--out", tmp_path / "out", *limits)
    text, err = said(capsys)
    model = tmp_path / "out" / "model"
    verdict = json.loads((model / "acceptance.json").read_text())
    assert code == (3 if verdict["failed"] else 0), err
    assert "used: 16 episodes" in text and "lost: nothing" in text and "Positions were not judged" in text
    assert "What the tokenizer loses was not judged: fewer than 24 episodes are held out" in text
    assert f"acceptance {verdict['outcome']}" in text and "--model-dir" in text
    names = [row["name"].split(", step")[0] for row in verdict["criteria"]]
    assert names == [
        "done precision in time on rollouts", "done recall on rollouts", "feature distance / copying",
        "feature distance, other / recorded actions",
    ]
    assert {"feature_ratio_h01", "feature_floor_h01", "other_actions_h01", "done_touch_the_post_auc"} <= {
        *verdict["metrics"]
    }
    assert load_model_folder(model).manifest["data"]["summary"][1].startswith("used: 16 episodes")

    kept = {path.name: path.read_bytes() for path in model.iterdir()}
    assert main(["train-model", "--out", str(tmp_path / "out")]) == code
    assert f"acceptance {verdict['outcome']}" in said(capsys)[0]
    assert {path.name: path.read_bytes() for path in model.iterdir()} == kept
    shutil.rmtree(model)
    assert main(["train-model", "--out", str(tmp_path / "out")]) == code
    assert {path.name: path.read_bytes() for path in model.glob("*.safetensors")} == {
        name: data for name, data in kept.items() if name.endswith(".safetensors")
    }
    assert train("--bags", bag.parent, "--out", tmp_path / "out") == 2
    assert "was begun with other options: --bags is" in said(capsys)[1]


def test_a_model_that_fails_is_kept_and_named_with_code_3(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train("--bags", bag, "--out", tmp_path / "out", "--acceptance.feature_error_ratio", 0.01) == 3
    err = said(capsys)[1]
    assert "feature distance / copying, step" in err and "train-policy takes the model only with --force" in err
    assert (tmp_path / "out" / "model" / "manifest.json").is_file()


def test_a_robot_without_state_is_judged_too(tmp_path: Path) -> None:
    bag = record(tmp_path / "bag", 16, **NO_STATE)
    assert train("--bags", bag, "--out", tmp_path / "out") in (0, 3)
    assert json.loads((tmp_path / "out" / "model" / "acceptance.json").read_text())["metrics"]["other_actions_h01"] > 0


def test_each_mistake_is_one_line_that_says_what_to_do(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, text in (
        ((), "name recordings with --bags"),
        (("--bags", tmp_path / "nothing"), "no bag at"),
        (("--bags", bag, "--tokenizer.patch_px", 16), "not a multiple of tokenizer.patch_px 16; set it to 8 or 4"),
        (("--bags", bag, "--task", "touch_the_pots"), "unknown task 'touch_the_pots'"),
        (("--bags", bag, "--task", "push_cube"), "was recorded for task 'touch_the_post', not 'push_cube'; leave"),
        (("--bags", bag, "--task", tmp_path / "none.py"), "is no file"),
    ):
        assert train(*words, "--out", tmp_path / "out") == 2
        err = said(capsys)[1]
        assert text in err and err.count("\n") == 1, err
        assert not (tmp_path / "out" / "config.yaml").exists(), "another try may have other options"


def test_a_task_file_names_the_task_of_the_recordings_and_is_known_in_another_working_folder(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("WM_TASKS", "")
    folder, out = tmp_path / "tasks", tmp_path / "out"
    folder.mkdir()
    file = folder / "touch_the_post.py"
    file.write_text("from wm_nodes.config.tasks import Task\nTASK = Task('touch the post')\n", encoding="utf-8")
    monkeypatch.chdir(folder)
    code = train("--bags", bag, "--task", file.name, "--out", out)
    assert code in (0, 3), said(capsys)[1]
    assert load_model_folder(out / "model").tasks == ("touch_the_post",)
    assert get_task("touch_the_post").instruction == "touch the post"

    shutil.rmtree(out / "model")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WM_TASKS", "")
    assert main(["train-model", "--out", str(out)]) == code, said(capsys)[1]
    assert os.environ["WM_TASKS"] == str(file)


def test_a_finished_run_opens_no_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag, out = record(tmp_path / "bag", 16), tmp_path / "out"
    code = train("--bags", bag, "--out", out)
    shutil.rmtree(bag)
    assert main(["train-model", "--out", str(out)]) == code, said(capsys)[1]
    shutil.rmtree(out / "model")
    assert main(["train-model", "--out", str(out)]) == 2
    assert "no bag at" in said(capsys)[1]
