"""The command that names models and the lines that serve them."""

import json
import shlex
import subprocess
import sys

import pytest

from wm_nodes.apps.cli import main
from wm_nodes.apps.judge.serve_help import MODELS, server_line, set_options
from wm_nodes.config.load import load_config, split_settings
from wm_nodes.judge.backends.factory import check_judge


def test_only_models_that_fit_the_memory_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["judge", "serve-help", "--memory", "24"]) == 0
    shown = capsys.readouterr().out
    assert "vllm serve Qwen/Qwen3-VL-8B-Instruct" in shown and "27B" not in shown and "397B" not in shown
    assert "Never run by us: every line above" in shown
    assert main(["judge", "serve-help"]) == 0
    shown = capsys.readouterr().out
    assert all(server_line(model) in shown for model in MODELS)
    assert main(["judge", "serve-help", "--memory", "4"]) == 1
    assert "the smallest needs 8 GB" in capsys.readouterr().out


def test_every_line_allows_what_our_settings_send() -> None:
    for model in MODELS:
        words = shlex.split(server_line(model))
        limit = json.loads(words[words.index("--limit-mm-per-prompt") + 1])
        _, overrides = split_settings(shlex.split(" ".join(set_options(model))))
        judge = load_config("cpu", {"judge.endpoints": ["http://x/v1"], "judge.model": model.name, **overrides}).judge
        check_judge(judge)
        assert judge.max_images == limit["image"] >= 23 and limit["video"] == 1
        thinks = "--reasoning-parser" in words
        assert thinks == (judge.extra_body == {"chat_template_kwargs": {"enable_thinking": False}})


def test_it_answers_without_torch() -> None:
    code = (
        "import sys; from wm_nodes.apps.cli import main; code = main(['judge', 'serve-help']); "
        "assert 'torch' not in sys.modules; raise SystemExit(code)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0
