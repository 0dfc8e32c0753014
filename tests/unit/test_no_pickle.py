"""Nothing that a file or a message brings is run as code: no pickle, no unsafe loader, no eval. From the source."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

MODULES = {"pickle", "_pickle", "cPickle", "cloudpickle", "dill", "joblib", "marshal", "shelve"}
YAML_LOADERS = {"SafeLoader", "CSafeLoader"}
UNSAFE_YAML = {"yaml.unsafe_load", "yaml.unsafe_load_all", "yaml.full_load", "yaml.full_load_all"}


def findings(source: str) -> list[str]:
    """What in the source could run code out of data, with its line."""
    tree = ast.parse(source)
    full_names = dict(_imports(tree))
    return [f"line {node.lineno}: {text}" for node in ast.walk(tree) for text in _problems(node, full_names)]  # type: ignore[attr-defined]


def _imports(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """The local name of each import, and its full name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.asname, alias.name) for alias in node.names if alias.asname)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((alias.asname or alias.name, f"{node.module}.{alias.name}") for alias in node.names)


def _problems(node: ast.AST, full_names: dict[str, str]) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (f"import {alias.name}" for alias in node.names if alias.name.split(".")[0] in MODULES)
    elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in MODULES:
        yield f"from {node.module} import"
    elif isinstance(node, ast.Call):
        first, dot, rest = ast.unparse(node.func).partition(".")
        name = (full_names.get(first, first) + dot + rest).replace("numpy.", "np.")
        given = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
        if name in {"eval", "exec", "builtins.eval", "builtins.exec"} | UNSAFE_YAML:
            yield f"{name}()"
        elif name == "torch.load" and given.get("weights_only") != "True":
            yield "torch.load() without weights_only=True"
        elif name == "np.load" and given.get("allow_pickle", "False") != "False":
            yield "np.load() with allow_pickle"
        elif name in {"yaml.load", "yaml.load_all"}:
            loader = given.get("Loader", ast.unparse(node.args[1]) if len(node.args) > 1 else "")
            if loader.rpartition(".")[2] not in YAML_LOADERS:
                yield f"{name}() without a safe loader"


@pytest.mark.parametrize(
    "source",
    [
        "import pickle", "import pickle as p", "from cloudpickle import loads", "eval(text)", "exec(text)",
        "import torch\ntorch.load(path)", "import torch as t\nt.load(path, weights_only=False)",
        "from torch import load\nload(path)", "import numpy as np\nnp.load(path, allow_pickle=True)",
        "import numpy\nnumpy.load(path, allow_pickle=flag)", "import yaml\nyaml.load(text)",
        "import yaml\nyaml.load(text, Loader=yaml.Loader)", "import yaml\nyaml.unsafe_load(text)",
    ],
)
def test_each_way_to_run_code_out_of_data_is_found(source: str) -> None:
    assert len(findings(source)) == 1


@pytest.mark.parametrize(
    "source",
    [
        "import torch\ntorch.load(path, weights_only=True)\nmodel.eval()", "import numpy as np\nnp.load(path)",
        "import yaml\nyaml.safe_load(text)\nyaml.load(text, Loader=yaml.CSafeLoader)",
    ],
)
def test_safe_calls_are_not_reported(source: str) -> None:
    assert findings(source) == []


@pytest.mark.parametrize("folder", ["wm_nodes", "launch_scripts"])
def test_the_product_runs_no_code_out_of_data(repository: Path, folder: str) -> None:
    files = sorted((repository / folder).rglob("*.py"))
    assert files
    found = {str(path): problems for path in files if (problems := findings(path.read_text(encoding="utf8")))}
    assert found == {}
