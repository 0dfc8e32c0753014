"""Whatever a person hands in as YAML: one line with file, line and remedy, wherever it is read."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from recording_samples import make_episode, make_spec

from wm_nodes.apps.cli import main
from wm_nodes.config.load import ConfigError, load_config, load_video_config, read_yaml
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.launching.runner import main as launch
from wm_nodes.recording import Bag, BagError, EpisodeBagWriter

NOBODY = 65534
WHOLE = "seed: 1\nppo:\n  updates: 3\n  hidden: [1, 2]\n"
BROKEN: dict[str, tuple[bytes, str]] = {
    "truncated": (WHOLE[:-4].encode(), ", line 4: no YAML: "),
    "cut_name": (WHOLE[:20].encode(), ""),
    "list": (b"- 1\n- 2\n", ", line 1: it holds a list, not a mapping (name: value)"),
    "text": (b"hello\n", ", line 1: it holds a str"),
    "empty": (b"\n", ", line 1: it holds nothing"),
    "tab": (b"seed: 1\n\tppo: 2\n", ", line 2: no YAML: "),
    "garbage": (b"seed: 1\n\xff\xfe\x00\x01", ", line 2: no text (UTF-8)"),
    "control": (b"seed: 1\nppo: \x01\n", ", line 2: no YAML: special characters are not allowed"),
    "unhashable": (b"seed: 1\n[1, 2]: 3\n? {a: 1}\n: 4\n", ", line 2: no YAML: "),
    "date": (b"seed: 2001-13-45\n", ": no YAML: month must be in 1..12"),
    "deep": (b"[" * 5000, ": no YAML: "),
}


def make(folder: Path, kind: str) -> Path:
    path = folder / f"{kind}.yaml"
    if kind == "folder":
        path.mkdir()
    elif kind != "missing":
        path.write_bytes(BROKEN[kind][0])
    return path


def said_by(read: Callable[[Path], object], path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        read(path)
    return str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*BROKEN, "folder", "missing"])
def test_presets_configurations_and_rubrics_say_what_is_wrong_where(kind: str, tmp_path: Path) -> None:
    path = make(tmp_path, kind)
    words = {"folder": " is a folder; name a", "missing": " does not exist; name a"}.get(kind) or BROKEN[kind][1]
    readers: list[Callable[[Path], object]] = [
        lambda path: load_config(str(path)), lambda path: load_video_config(str(path)),
        lambda path: load_rubric(str(path)),
    ]
    for read in readers:
        text = said_by(read, path)
        assert "\n" not in text and str(path) in text, text
        assert f"{path}{words}" in text or kind == "missing" or not words
    if words and kind not in ("folder", "missing"):
        assert said_by(read_yaml, path).endswith("; mend the file, or copy it again")


def test_a_file_of_comments_changes_nothing(tmp_path: Path) -> None:
    (tmp_path / "none.yaml").write_text("# nothing yet\n")
    assert load_config(str(tmp_path / "none.yaml")) == load_config("base")


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become nobody")
def test_a_file_without_permission_is_named(tmp_path: Path) -> None:
    path = tmp_path / "secret.yaml"
    path.write_text("seed: 1\n")
    path.chmod(0o600)
    code = (
        "import os, sys; from pathlib import Path; from wm_nodes.config.load import read_yaml\n"
        f"os.chdir({str(tmp_path)!r}); os.setuid({NOBODY})\n"
        "try: read_yaml(Path('secret.yaml'))\nexcept ValueError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "secret.yaml cannot be read: Permission denied; make it readable, or name another file\n"


@pytest.mark.parametrize("kind", ["truncated", "list", "garbage", "missing", "folder"])
def test_commands_and_launch_files_end_with_one_line(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, run, saved = make(tmp_path, kind), tmp_path / "run", tmp_path / "saved"
    saved.mkdir()
    (saved / "config.yaml").mkdir() if kind == "folder" else (saved / "config.yaml").write_bytes(
        BROKEN.get(kind, (b"", ""))[0]
    )
    (tmp_path / "manifest.json").write_text("{}")
    model = [f"model_dir:={tmp_path}", f"run_dir:={run}"]
    judge = ["--reward", "agent", "--judge", "http://a/v1", "--judge-model", "judge", "--ppo.num_steps", "16"]
    commands: list[Callable[[], int]] = [
        lambda: main(["train-policy", "--preset", str(path), "--run-dir", str(run)]),
        lambda: main(["train-video-model", "--preset", str(path), "--run-dir", str(run)]),
        lambda: main(["train-policy", "--preset", "smoke", *judge, "--rubric", str(path), "--run-dir", str(run)]),
        lambda: launch("evaluate", [f"preset:={path}", *model]),
        lambda: launch("world_model_rl", [f"preset:={path}", *model, "video_model_dir:=m", "context_bags:=b"]),
        lambda: launch("evaluate", [f"params_file:={path}", *model]),
        lambda: launch("world_model_rl", [f"params_file:={path}", *model, "video_model_dir:=m", "context_bags:=b"]),
    ]
    if kind != "missing":
        commands += [
            lambda: main(["train-policy", "--run-dir", str(saved)]),
            lambda: main(["train-video-model", "--run-dir", str(saved)]),
            lambda: launch("evaluate", [model[0], f"run_dir:={saved}"]),
        ]
    for number, command in enumerate(commands):
        assert command() == 2, number
        text = capsys.readouterr().err
        assert text.startswith("error: ") and text.count("\n") == 1, text
        assert str(path if number < 7 else saved / "config.yaml") in text
        assert not run.exists()


@pytest.mark.parametrize("kind", ["truncated", "list", "garbage", "missing", "folder"])
def test_a_node_ends_with_one_line(kind: str, tmp_path: Path) -> None:
    path = make(tmp_path, kind)
    code = "import sys; from wm_nodes.ros.spin import run_nodes; sys.exit(run_nodes(lambda: []))"
    command = [sys.executable, "-c", code, "--ros-args", "--params-file", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith(f"error: {path}")


@pytest.mark.parametrize("kind", ["truncated", "list", "garbage", "empty", "folder"])
def test_a_bag_names_its_broken_metadata(kind: str, tmp_path: Path) -> None:
    spec, path = make_spec(height=8, width=8), tmp_path / "bag" / "metadata.yaml"
    with EpisodeBagWriter(tmp_path / "bag", spec, run_id="run", start_ns=1) as bag:
        bag.write(make_episode(spec, 0, 3))
    path.unlink()
    make(tmp_path, kind).rename(path)
    with pytest.raises(BagError) as caught:
        Bag(tmp_path / "bag")
    text = str(caught.value)
    assert "\n" not in text and f"is damaged: {path}{BROKEN.get(kind, (b'', ' is a folder'))[1]}" in text
    assert "run `wm recover-bag" in text


def test_a_value_of_the_command_line_is_one_line_too(capsys: pytest.CaptureFixture[str]) -> None:
    for text in ("[1", "2001-13-45", "{a: b: c}"):
        assert main(["train-policy", "--ppo.updates", text]) == 2
        said = capsys.readouterr().err
        assert f"{text!r} of ppo.updates is no YAML: " in said and said.count("\n") == 1
