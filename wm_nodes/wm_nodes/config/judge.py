"""What the settings of the reward agent mean, which both loops have; presets/judge.yaml has the numbers."""

from typing import Annotated, Any, Literal

from pydantic import Field

from wm_nodes.config.sections import PositiveFloat, PositiveInt, SettingsSection


class StageJudge(SettingsSection):
    """A judge of some stages of every clip; as in JudgeConfig, whose other values it shares."""

    kind: Literal["openai", "embedded"] = "openai"
    """openai: a server; embedded: a judge in this process, from `folder`."""
    endpoints: list[str] = Field(default=[])
    """openai: base URLs with their /v1, in the order in which they are tried."""
    model: str = ""
    """openai: the model's name on the server."""
    api_key_env: str = ""
    """openai: name of the environment variable that holds the key; empty: the server wants none."""
    folder: str = ""
    """embedded: folder of a world model with normal ranges; empty: the shipped one of the task."""
    extra_body: dict[str, Any] = Field(default={})
    """openai: further fields of every request."""
    stages: Annotated[list[Literal["PLAN", "VQ", "IF", "TC", "PC", "HACK"]], Field(min_length=1)]
    """The stages that it judges."""


class JudgeConfig(SettingsSection):
    """The reward agent: its judge, its rubric, and its limits of time and calls (judge/agent, judge/backends)."""

    kind: Literal["openai", "embedded"]
    """openai: a server that speaks chat completions, such as vLLM; embedded: a judge in this process, from `folder`."""
    endpoints: list[str]
    """openai: base URLs with their /v1, in the order in which they are tried; all serve `model`."""
    model: str
    """openai: the model's name on the server."""
    api_key_env: str
    """openai: name of the environment variable that holds the key; empty: the server wants none."""
    folder: str
    """embedded: folder of a world model with normal ranges (wm judge calibrate); empty: the shipped one of the task."""
    conformal: Annotated[float, Field(ge=0, lt=1)]
    """embedded: abstain on what is stranger than this share of the recordings and not beyond the limit; below 0.97; 0:
    always decide."""
    rubric: str
    """Rubric pack: a name, or a .yaml file."""
    mode: Literal["reward", "benchmark", "topreward"]
    """reward: a closed gate ends the reading of a clip; benchmark: every component is read; topreward: the reward is
    the probability of "True" for "the task is completed", one token of a server, without planning or gates."""
    call_plan: Literal["auto", "pack", "fanout"]
    """One call per stage (pack) or per component (fanout); auto: by the measured cache, not repeatable bit by bit."""
    robot: str
    """Description of the robot in the judge's prompt."""
    concurrency: PositiveInt
    """Clips judged at the same time."""
    max_in_flight: PositiveInt
    """Calls under way at one endpoint; halved when it is overloaded."""
    max_reads: PositiveInt
    """Of one clip, votes and second looks included."""
    clip_budget_s: PositiveFloat
    """A clip without a verdict after this time has no reward."""
    tries: PositiveInt
    """Requests per call, over all endpoints."""
    json_timeout_s: PositiveFloat
    """Longest wait of one try for an answer with reasons."""
    label_timeout_s: PositiveFloat
    """Longest wait of one try for an answer of a single token."""
    max_images: Annotated[int, Field(ge=2)]
    """Images that the server takes in one call."""
    video: bool
    """Send the dense frames of a clip as one video instead of images; for vLLM."""
    choice_grammar: bool
    """openai: a read of one token may only be a listed letter (vLLM); without it, a read that is mostly other words
    abstains."""
    label_token_ids: list[int]
    """openai: token ids of A to E, for servers that give the probabilities of given ids (vLLM: logprob_token_ids)."""
    extra_body: dict[str, Any]
    """openai: further fields of every request, e.g. {chat_template_kwargs: {enable_thinking: false}} for a model that
    reasons before it answers, {max_completion_tokens: 4096} in place of the judge's own max_tokens, or vLLM's
    mm_processor_kwargs and media_io_kwargs."""
    repeat_share: Annotated[float, Field(ge=0, le=1)]
    """Share of the calls to a server that are made twice: `flip_rate` says how often the second answer is another."""
    keep_reads: bool
    """Keep every answer in <run>/judge_reads, by content: the same clip is not asked about twice, and scoring a bag
    again gives the same verdicts."""
    routes: list[StageJudge]
    """Other judges for some stages, e.g. [{stages: [TC, PC], endpoints: [URL], model: NAME}] beside the embedded one. A
    verdict is of all of them together; where one does not answer, the clip has no reward."""
