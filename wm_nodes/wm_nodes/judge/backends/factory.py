"""A judge from the configuration's `judge` section."""

import re
from collections.abc import Callable, Coroutine
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from wm_nodes.config.judge import JudgeConfig, StageJudge
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.device import CPU
from wm_nodes.judge.agent import topreward
from wm_nodes.judge.agent.judge import Judge
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import Stage
from wm_nodes.judge.backends import one_class
from wm_nodes.judge.backends.cache import VerdictCache
from wm_nodes.judge.backends.calls import OWN_FIELDS, Exchange
from wm_nodes.judge.backends.one_class import OneClassJudge
from wm_nodes.judge.backends.openai_client import OpenAIJudge
from wm_nodes.judge.backends.prompts import LETTERS
from wm_nodes.judge.backends.routed import RoutedJudge
from wm_nodes.judge.backends.transport import ChatTransport, Endpoint, RetryPolicy
from wm_nodes.judge.one_class.ranges import KEPT, has_ranges
from wm_nodes.world_model.folder import read_world_manifest

AnyJudge = TypeVar("AnyJudge", JudgeConfig, StageJudge)
_VARIABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


@dataclass(frozen=True)
class OpenedJudge:
    """A judge and what ends it: `close` is awaited on the event loop that asked the judge."""

    judge: Judge
    close: Callable[[], Coroutine[Any, Any, None]]


def _all_of(settings: JudgeConfig) -> list[JudgeConfig | StageJudge]:
    """The judge and those of some stages."""
    return [settings, *settings.routes]


def _route_judge(settings: JudgeConfig, route: StageJudge) -> JudgeConfig:
    """The settings of the judge of some stages, who has nobody beside it."""
    given = {name: getattr(route, name) for name in StageJudge.model_fields if name != "stages"}
    return settings.model_copy(update={**given, "routes": []})


def check_judge(settings: JudgeConfig) -> None:
    """Refuse settings that name no judge. Raises ValueError: names setting and remedy, never what may be a key."""
    _check_one(settings)
    for number, route in enumerate(settings.routes):
        try:
            _check_one(_route_judge(settings, route))
        except ValueError as error:
            raise ValueError(f"judge.routes[{number}]: {error}") from None
    stages = [stage for route in settings.routes for stage in route.stages]
    if twice := sorted({stage for stage in stages if stages.count(stage) > 1}):
        raise ValueError(f"judge.routes names {', '.join(twice)} more than once; one judge reads a stage")


def _check_one(settings: JudgeConfig) -> None:
    if settings.mode == topreward.MODE and (settings.kind == "embedded" or settings.routes):
        raise ValueError(
            "judge.mode topreward reads the probability of a word from one server: set judge.endpoints and judge.model "
            f"(got judge.kind {settings.kind}), and leave judge.routes empty"
        )
    if settings.kind == "embedded":
        if settings.folder and not has_ranges(Path(settings.folder)):
            raise ValueError(
                f"judge.folder {settings.folder!r} holds no normal ranges; make a world-model folder a judge with wm "
                "judge calibrate MODEL_DIR BAG, or leave judge.folder empty for the task's shipped one"
            )
        if settings.conformal >= KEPT:
            raise ValueError(f"judge.conformal must be below {KEPT}, what the limit keeps, got {settings.conformal}")
        return
    if not settings.endpoints or not settings.model:
        raise ValueError(
            "the reward agent needs a judge: set judge.endpoints, e.g. [http://127.0.0.1:8000/v1], and judge.model "
            f"(got {settings.endpoints} and {settings.model!r})"
        )
    if settings.api_key_env and not _VARIABLE.fullmatch(settings.api_key_env):
        raise ValueError(
            "judge.api_key_env must be the name of an environment variable, e.g. JUDGE_API_KEY; what is there is no "
            "name, perhaps a key, and is not repeated here"
        )
    if settings.label_token_ids and len(settings.label_token_ids) != len(LETTERS):
        raise ValueError(
            f"judge.label_token_ids must hold {len(LETTERS)} ids, of A to E, or none, got {settings.label_token_ids}"
        )
    if taken := sorted(OWN_FIELDS & settings.extra_body.keys()):
        raise ValueError(f"judge.extra_body sets {', '.join(taken)}, which the judge sets itself; leave it out")


def for_task(settings: JudgeConfig, task: str) -> JudgeConfig:
    """The settings with the task's shipped world model wherever an embedded judge has no folder.

    Raises:
        ValueError: no world model is shipped for the task, or it is no judge; names the remedy.
    """

    def name_folder(judge: AnyJudge) -> AnyJudge:
        if judge.kind != "embedded" or judge.folder:
            return judge
        return judge.model_copy(update={"folder": str(_shipped(task))})

    return name_folder(settings).model_copy(update={"routes": [*map(name_folder, settings.routes)]})


def _shipped(task: str) -> Path:
    """The folder of the judge that is shipped for a task. Raises ValueError."""
    with suppress(FileNotFoundError):
        if has_ranges(folder := shipped_model(task)):
            return folder
    raise ValueError(
        f"no judge is shipped for task {task!r} (named in clips.jsonl, in bags or by --task); name a server (--judge "
        "URL --judge-model NAME), or calibrate a world model of your own (wm judge calibrate MODEL_DIR BAG, then "
        "--judge MODEL_DIR)"
    )


def check_clips(settings: JudgeConfig, shape: tuple[int, ...], fps: float | None = None) -> None:
    """Refuse a judge that would abstain on every such clip; likewise routed ones. Servers take any.

    Args:
        settings: of for_task.
        shape: (frames, height, width, 3).
        fps: frames per second; None: those of its first ranges.

    Raises:
        ValueError: names the shape and the remedy; or the folder holds no judge.
    """
    for judge in _all_of(settings):
        if judge.kind != "embedded":
            continue
        folder = Path(judge.folder)
        manifest = read_world_manifest(folder)
        if reason := one_class.unfit_reason(one_class.ranges_of(folder, manifest), manifest, shape, fps):
            raise ValueError(
                f"the embedded judge {folder} cannot judge clips of {shape[0]} frames, {shape[1]} x {shape[2]} px: "
                f"{reason}. Name a server (judge.kind openai, judge.endpoints, judge.model), or in judge.folder a "
                "world model of such clips with normal ranges (wm judge calibrate)"
            )


def evidence_judge(settings: JudgeConfig, model_dir: Path | None, device: str = CPU) -> OneClassJudge | None:
    """The judge in this process whose numbers are the evidence beside a server's answers (RA-17); None where no server
    judges, or the world model has no normal ranges.
    """
    embedded = all(judge.kind == "embedded" for judge in _all_of(settings))
    if model_dir is None or embedded or not has_ranges(model_dir):
        return None
    return OneClassJudge(model_dir, device=device)


def judge_name(settings: JudgeConfig) -> str:
    """Who judges, in words for people."""
    embedded = settings.kind == "embedded"
    who = f"embedded judge {settings.folder or 'of the task'}"
    name = who if embedded else f"{settings.model} at {', '.join(settings.endpoints)}"
    by = [f"{'+'.join(route.stages)} by {judge_name(_route_judge(settings, route))}" for route in settings.routes]
    return "; ".join([name, *by])


def make_judge(
    settings: JudgeConfig, rubric: Rubric, reads: Path | None = None,
    on_exchange: Callable[[Exchange], None] = lambda exchange: None, *, device: str = CPU,
) -> OpenedJudge:
    """Make the judge that the settings name; nothing is asked yet.

    Args:
        reads: folder of the reads that were bought before, see VerdictCache; None: none are kept. Of servers only.
        on_exchange: called with the words of every request to a server and its raw reply.
        device: the setting `device` (core/device.py), where an embedded judge computes.

    Raises:
        ValueError: as check_judge and compute_device; the key's environment variable is not set, or the folder holds no
            judge.
        MissingPackageError: the client package is not installed.
    """
    check_judge(settings)
    open_judge = partial(_open, rubric=rubric, reads=reads, on_exchange=on_exchange, device=device)
    first = open_judge(settings)
    if not settings.routes:
        return first
    routed = [open_judge(_route_judge(settings, route)) for route in settings.routes]
    routes = [([Stage(s) for s in r.stages], o.judge) for r, o in zip(settings.routes, routed, strict=True)]

    async def close() -> None:
        for opened in (first, *routed):
            await opened.close()

    return OpenedJudge(RoutedJudge(first.judge, routes, rubric), close)


def _open(
    settings: JudgeConfig, rubric: Rubric, reads: Path | None, on_exchange: Callable[[Exchange], None], device: str
) -> OpenedJudge:
    """The judge itself, whatever its routes."""
    if settings.kind == "embedded":
        if not settings.folder:
            raise ValueError("judge.folder is empty; name a world-model folder with normal ranges, see for_task")
        return OpenedJudge(OneClassJudge(Path(settings.folder), settings.conformal, device), _close_nothing)
    transport = ChatTransport(
        [Endpoint(url, settings.model, settings.api_key_env, settings.max_in_flight) for url in settings.endpoints],
        retry=RetryPolicy(settings.tries),
    )
    cache = VerdictCache(reads) if reads is not None and settings.keep_reads else None
    return OpenedJudge(OpenAIJudge(transport, rubric, settings, cache, on_exchange), transport.close)


async def _close_nothing() -> None:
    """What ends a judge that holds nothing."""
