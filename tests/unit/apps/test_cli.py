"""The command `wm`: every verb explains itself, and errors are one line with one set of exit codes."""

import argparse
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import yaml

from benchmarks.experiment import EXPERIMENTS
from wm_nodes.apps import cli, options
from wm_nodes.config.load import load_config
from wm_nodes.core.errors import ModelNotAcceptedError, RunError
from wm_nodes.reports.live_page import LivePage

OPTIONS = {
    "train-model": "--bags --task --out --run-dir --preset --SECTION.KEY --device --seed",
    "train-policy": "--preset --SECTION.KEY --device --task --seed --run-dir --model-dir --from-scratch --force "
    "--environment --video-model --reward --judge --judge-model --judge-key-env --rubric --compose "
    "--view --domain-id --verbose",
    "train-video-model": "--preset --SECTION.KEY --seed --run-dir --from-scratch --bags --heldout-bags --keep-buffers "
    "--reward --judge --judge-model --judge-key-env --rubric --tensorboard --no-tensorboard --view --domain-id "
    "--verbose",
    "check-video-model": "--video-model --context-bags --public --prompt --picture --size --lora-rank --preset "
    "--SECTION.KEY",
    "collect": "folder --tasks --episodes --first-seed --preset --SECTION.KEY --device",
    "view": "BAG|RUN_FOLDER --rate --loop --port",
    "rescore": "recording --reward --judge --judge-model --judge-key-env --rubric --json --config --model-dir "
    "--namespace --reads --audit",
    "follow-clips": "run --out --episodes --version --device",
    "retrain": "run --run-dir --SECTION.KEY --tensorboard",
    "recover-bag": "bag --output",
    "import rosbag": "contract bags --out",
    "judge-clips": "clips --config --device --judge --judge-model --judge-key-env --rubric --mode --audit --reads "
    "--json",
    "judge check": "judge --model --key-env --rubric --limit --reads --SECTION.KEY --device --json",
    "judge serve-help": "--memory",
    "judge calibrate": "model_dir bags --stride --moving --seed --device",
    "judge hack": "clips --config --device --judge --judge-model --judge-key-env --rubric --least --limit "
    "--limit-clips --seed --reads --json --pictures",
    "audit": "verify recover sample view agree people replay",
    **{f"{'reproduce' if name == 'roboscape' else 'benchmark'} {name}": "--json" for name in EXPERIMENTS},
    "benchmark tables": "--check --docs",
}


def shown(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as end:
        cli.main([*words, "--help"])
    assert end.value.code == 0
    return capsys.readouterr().out


def test_every_verb_is_listed_with_what_it_does(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ([], ["--help"], ["-h"]):
        assert cli.main(words, "wm.py") == 0
        listed = capsys.readouterr().out
        assert listed.startswith("usage: wm.py VERB") and "130 interrupted" in listed
        assert all(f"  {name} " in listed and about in listed for name, about in cli.VERBS.items())
    assert set(OPTIONS) == set(cli.VERBS)
    for words in (["benchmark"], ["benchmark", "--help"]):
        assert cli.main(words) == 0
        listed = capsys.readouterr().out
        assert "benchmark diversity" in listed and "train-policy" not in listed


@pytest.mark.parametrize("verb", OPTIONS)
def test_every_verb_explains_itself_and_names_its_options(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = shown(verb.split(), capsys)
    assert text.startswith(f"usage: wm {verb} ") and "exit codes: 0 done" in text
    for option in OPTIONS[verb].split():
        assert re.search(rf"(^|[\s,{{|\[]){re.escape(option)}($|[\s,}}|\]])", text), f"{option} is not in\n{text}"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["train-polcy"], "unknown verb 'train-polcy'; did you mean 'train-policy'? wm --help lists the verbs"),
        (["doctor"], "unknown verb 'doctor'; wm --help lists the verbs"),
        (["benchmark", "hackin"], "unknown verb 'benchmark hackin'; did you mean 'benchmark hacking'?"),
        (["recover-bag", "nothing-here"], "no .mcap file at nothing-here"),
        (["rescore", "nothing-here"], "nothing-here holds no config.yaml; name the run folder"),
        (["train-policy", "--ppo.updates", "many"], "ppo.updates"),
        (["train-policy", "--preset", "nosuch"], "nosuch"),
        (["train-policy", "--preset", "gpu", "--device", "cpu"], "table_top_cube was trained with 64; width 256"),
        (["train-policy", "--environment", "video_model"], "--video-model DIR go together; give both, or none"),
        (["train-policy", "--video-model", "nothing-here"], "--video-model DIR go together; give both, or none"),
        (["train-policy", "--environment", "video_model", "--video-model", "nowhere"], "nowhere holds no manifest"),
        (["train-video-model", "--iterations", "many"], "iterations: Input should be a valid integer"),
        (["train-video-model", "--model.width"], "expected a value behind --model.width"),
        (["train-policy", "--ppo.update", "3"], "unknown setting 'ppo.update'; did you mean 'ppo.updates'?"),
        (["train-policy", "--pppo.updates", "3"], "unknown setting 'pppo'; did you mean 'ppo'?"),
    ],
)
def test_an_error_is_one_line_and_code_2(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == 2
    text = capsys.readouterr().err
    assert text.startswith("error: ") and text.count("\n") == 1 and said in text


@pytest.mark.parametrize("words", [["follow-clips", "--out", "bag"], ["retrain"]])
def test_what_takes_a_run_of_a_video_model_says_so_of_another_run(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(load_config("smoke").model_dump()), encoding="utf-8")
    assert cli.main([words[0], str(tmp_path), *words[1:]]) == 2
    assert f"{tmp_path} is no run of a video model; name the run" in capsys.readouterr().err


def test_a_page_that_cannot_be_opened_is_one_line_before_anything_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with LivePage() as other:
        for verb in ("train-policy", "train-video-model"):
            assert cli.main([verb, "--preset", "smoke", "--view", str(other.port)]) == 2
            text = capsys.readouterr().err
            assert text.startswith(f"error: port {other.port} of this host cannot be used") and text.count("\n") == 1
    assert not [*tmp_path.iterdir()]


def test_a_wrong_option_is_one_line_and_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["recover-bag"], ["audit", "verify"], ["audit", "sing"], ["retrain", "run", "--seed", "1"],
                  ["audit", "verify", "log", "--ppo.updates", "3"], ["judge-clips", "clips", "--ppo.updates", "3"]):
        with pytest.raises(SystemExit, match="2"):
            cli.main(words)
        text = capsys.readouterr().err
        assert text.startswith("error: ") and text.count("\n") == 1 and f"see wm {words[0]}" in text


@pytest.mark.parametrize("verb", ["train-video-model", "check-video-model"])
def test_loop_2_takes_its_task_as_an_option(verb: str) -> None:
    parser = cli.parser_of(verb, f"wm {verb}")
    assert options.settings(parser.parse(["--task", "push"])) == {"task": "push"}
    assert options.settings(parser.parse([])) == {}


def test_a_misspelt_option_is_answered_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    for words, near in ((["train-policy", "--rund-dir", "x"], "--run-dir"),
                        (["train-video-model", "--iteration", "3"], "--iterations")):
        with pytest.raises(SystemExit, match="2"):
            cli.main(words)
        assert f"did you mean {near}?; see wm {words[0]} --help" in capsys.readouterr().err


def verb_that(does: Callable[[argparse.Namespace], int | None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the verb `retrain` do this instead."""
    module = SimpleNamespace(__doc__="Something else.", add_options=lambda parser: None, run=does)
    monkeypatch.setattr(cli, "import_module", lambda name: module)


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (ModelNotAcceptedError("tool error failed"), 3, "error: tool error failed\n"),
        (RunError("a node ended"), 2, "error: a node ended\n"),
        (ValueError("two\nlines"), 2, "error: two lines\n"),
        (OSError("disk full"), 2, "error: disk full\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
    ],
)
def test_each_kind_of_end_has_its_code(
    error: BaseException, code: int, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(arguments: argparse.Namespace) -> None:
        raise error

    verb_that(fail, monkeypatch)
    assert cli.main(["retrain"]) == code
    assert capsys.readouterr().err == said


def test_the_command_is_kept_as_typed_and_a_fault_of_ours_shows_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    commands = []
    verb_that(lambda arguments: commands.append(arguments.command), monkeypatch)
    assert cli.main(["retrain"]) == 0
    assert cli.run_verb("train-policy", [], "python3 launch_scripts/online_rl.py") == 0
    assert commands == ["wm retrain", "python3 launch_scripts/online_rl.py"]
    verb_that(lambda arguments: 1, monkeypatch)
    assert cli.main(["retrain"]) == 1
    verb_that(lambda arguments: {}["missing"], monkeypatch)
    with pytest.raises(KeyError, match="missing"):
        cli.main(["retrain"])


def test_without_the_repository_a_benchmark_says_where_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing(name: str) -> ModuleType:
        raise ModuleNotFoundError(f"No module named {name!r}", name="benchmarks")

    monkeypatch.setattr(cli, "import_module", missing)
    assert cli.main(["benchmark", "speed"]) == 2
    assert "the benchmarks come with the repository" in capsys.readouterr().err


def test_the_list_of_verbs_is_there_at_once_and_the_scripts_start_the_command(repository: Path) -> None:
    loaded = "import sys; from wm_nodes.apps.cli import main; main(['--help']); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("False\n"), "wm --help imports torch"
    for name in ("wm", "online_rl"):
        assert "wm_nodes.apps.cli import" in (repository / "launch_scripts" / f"{name}.py").read_text()
    assert '"wm = wm_nodes.apps.cli:main"' in (repository / "wm_nodes" / "setup.py").read_text()


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["-m", "wm_nodes.apps.cli", "recover-bag", "nothing-here"], 2, "error: no .mcap file at nothing-here, nor "),
        (["-m", "wm_nodes.apps.cli", "retrain", "--help"], 0, "usage: python -m wm_nodes.apps.cli retrain [-h]"),
        (["-m", "wm_nodes.apps.train_policy", "--seed", "1"], 2, "error: wm_nodes.apps.train_policy is not started by "
                                                                "itself; type: wm train-policy\n"),
        (["-mwm_nodes.apps.options"], 2, "error: wm_nodes.apps.options is not started by itself; type: wm --help\n"),
    ],
)
def test_a_module_of_a_verb_works_with_python_m_or_says_what_to_type(
    words: list[str], code: int, said: str, tmp_path: Path
) -> None:
    done = subprocess.run([sys.executable, *words], cwd=tmp_path, capture_output=True, encoding="utf-8", check=False)
    assert done.returncode == code and (done.stderr + done.stdout).startswith(said), done


def test_ctrl_c_while_a_verb_is_imported_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(name: str) -> ModuleType:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "import_module", interrupted)
    assert cli.main(["collect"]) == 130
    assert capsys.readouterr().err == "interrupted\n"
