"""The judges that the benchmark can be told to use: those of a run (judges/factory.py), and the control."""

import argparse
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from benchmarks.judge.comparisons.chat import ChatComparison
from benchmarks.judge.label_judge import LabelJudge
from benchmarks.judge.labels import known_labels
from wm_nodes.config.load import load_config
from wm_nodes.config.schema import JudgeConfig, StageJudge
from wm_nodes.core.device import compute_device
from wm_nodes.judge.agent.judge import Judge
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.backends.embedded import EmbeddedJudge, shipped_head
from wm_nodes.judge.backends.factory import make_judge
from wm_nodes.judge.backends.transport import ChatTransport, Endpoint, RetryPolicy
from wm_nodes.judge.dataset.edits.manifest import Manifest
from wm_nodes.judge.evidence.head import load_head

NAMES = ("embedded", "openai", "simulator")


@asynccontextmanager
async def open_judge(
    arguments: argparse.Namespace, rubric: Rubric, manifest: Manifest, reads: Path
) -> AsyncIterator[Judge]:
    """The judge that --judge names, closed afterwards. reads: folder of the answers that were bought from a server.

    Raises:
        ValueError: a setting it needs is missing, named, or --stages is given to another judge than the embedded one.
        MissingPackageError: the client of a chat server.
    """
    if arguments.stages and arguments.judge != "embedded":
        raise ValueError(f"--stages gives stages of the embedded judge to --model; got --judge {arguments.judge}")
    if arguments.judge == "simulator":
        yield LabelJudge({row.sha256: known_labels(row.labels, row.edits) for row in manifest.rows}, rubric)
        return
    if arguments.judge == "embedded" and not arguments.stages:
        head = load_head(arguments.folder or shipped_head(), compute_device(arguments.device))
        yield EmbeddedJudge(head, arguments.conformal)
        return
    settings = server_settings(arguments)
    if arguments.judge == "embedded":
        server = {name: getattr(settings, name) for name in ("endpoints", "model", "api_key_env")}
        settings = settings.model_copy(update={
            "kind": "embedded", "folder": str(arguments.folder or ""), "conformal": arguments.conformal,
            "endpoints": [], "model": "", "routes": [StageJudge(stages=arguments.stages, **server)],
        })
    opened = make_judge(settings, rubric, reads, device=arguments.device)
    try:
        yield opened.judge
    finally:
        await opened.close()


@asynccontextmanager
async def open_comparison(arguments: argparse.Namespace) -> AsyncIterator[ChatComparison]:
    """What asks the same server by other papers' protocols. Raises ValueError: no server is named."""
    settings = server_settings(arguments)
    transport = ChatTransport(
        [Endpoint(url, settings.model, settings.api_key_env, settings.max_in_flight) for url in settings.endpoints],
        retry=RetryPolicy(settings.tries),
    )
    try:
        yield ChatComparison(transport, timeout_s=settings.json_timeout_s, seed=arguments.seed)
    finally:
        await transport.close()


def server_settings(arguments: argparse.Namespace) -> JudgeConfig:
    """The configuration's server with what the command line says of it.

    Raises:
        ValueError: no server or model is named.
    """
    if not arguments.url or not arguments.model:
        raise ValueError("a chat judge needs --url http://HOST:PORT/v1 and --model NAME")
    given: dict[str, Any] = {
        "kind": "openai", "endpoints": arguments.url, "model": arguments.model,
        "api_key_env": arguments.api_key_env, "rubric": arguments.rubric, "max_images": arguments.max_images,
    }
    return load_config("cpu").judge.model_copy(update=given)
