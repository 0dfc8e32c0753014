"""Say which open vision-language model fits which memory, how it is served, and what judging a clip costs.

    wm judge serve-help
    wm judge serve-help --memory 24

Nothing is downloaded or started. The lines are for vLLM on GPUs and were looked up on 2026-11-27; none of them was run
by us. What a model is worth as a judge, wm judge check measures.
"""

import argparse
import json
import shlex
from dataclasses import dataclass, field
from typing import Any

from wm_nodes.judge.agent import profiles
from wm_nodes.judge.agent.rubric import Rubric, load_rubric

URL = "http://127.0.0.1:8000/v1"
MOST_IMAGES = profiles.DENSE_MAX
CONTEXT_TOKENS = 16_384
"""32 images of 480 x 832 px are 12,480 tokens; the texts and an answer are below 3,000."""
IMAGE_TOKENS = {"96 x 96": 64, "480 x 832": 390}
"""Of a picture of so many px for the Qwen-VL kind: one per 32 x 32 px, of at least 65,536 px."""
TEXT_TOKENS = 750
"""Of a call's texts by the robot rubric, at most: 3,000 characters at 4 a token."""
MEASURED = ((7, 69), (19, 213))
"""Calls and images of a clip: mode reward where the first gate closes after votes; mode benchmark, all unclear."""
QWEN_LETTERS = [32, 33, 34, 35, 36]
"""Token ids of A to E in the vocabulary of Qwen3-VL."""


@dataclass(frozen=True)
class ServedModel:
    """A model that our judge can ask."""

    name: str
    """Of its repository on Hugging Face."""
    memory_gb: int
    """Of GPUs, all together: weights, and 2 to 6 GB for images and cache."""
    about: str
    """What it is good for, a phrase."""
    num_gpus: int = 1
    """Over which vLLM splits it."""
    flags: tuple[str, ...] = ()
    """Besides those that every line has."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Of the section judge."""


NO_THINKING = {"extra_body": {"chat_template_kwargs": {"enable_thinking": False}}}
THINKS = ("--reasoning-parser qwen3",)
QWEN = {"label_token_ids": QWEN_LETTERS}
FAMILY = "of the paper's family. vLLM's prefix cache is of no use to this kind with pictures"
MODELS = (
    ServedModel("Qwen/Qwen3-VL-2B-Instruct", 8, "tries the set-up out; too small to judge", settings=QWEN),
    ServedModel("Qwen/Qwen3-VL-4B-Instruct", 12, "the smallest to try; no published number as a judge", settings=QWEN),
    ServedModel(
        "nvidia/Cosmos3-Nano", 20, "its reasoner, trained on physics; its repository asks for your consent, and older "
        "vLLM does not know it: take NVIDIA's image vllm/vllm-openai:cosmos3", flags=THINKS, settings=NO_THINKING,
    ),
    ServedModel(
        "Qwen/Qwen3-VL-8B-Instruct", 24, "the one to begin with; its probability of True told successes apart with an "
        "AUROC of 0.826 (TOPReward)", settings=QWEN,
    ),
    ServedModel("Qwen/Qwen3.6-27B-FP8", 40, FAMILY, flags=THINKS, settings=NO_THINKING),
    ServedModel(
        "Qwen/Qwen3.5-397B-A17B-FP8", 640, f"the paper's judge, 91 of 100 clips; {FAMILY}", num_gpus=8, flags=THINKS,
        settings=NO_THINKING,
    ),
)
"""By memory."""


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--memory", type=float, metavar="GB", help="only models that fit; of all your GPUs together")


def run(arguments: argparse.Namespace) -> int:
    """Print the models that fit, and the cost of a clip; return 1 where none fits."""
    fitting = [model for model in MODELS if arguments.memory is None or model.memory_gb <= arguments.memory]
    if not fitting:
        print(f"no model fits {arguments.memory:g} GB; the smallest needs {MODELS[0].memory_gb} GB. The judge without "
              "a server (--judge embedded) needs no GPU")
        return 1
    print("pip install 'vllm>=0.32' into an environment of its own; then one of these, smallest first.\n")
    for model in fitting:
        print(f"{model.memory_gb} GB: {model.name}, {model.about}")
        print(f"  {server_line(model)}")
        print(" ", *(f"wm judge check {URL} --model {model.name}", *set_options(model)), "\n")
    print(_cost(load_rubric("robot")))
    print(NOTES)
    return 0


def server_line(model: ServedModel) -> str:
    """The command that serves a model."""
    limit = json.dumps({"image": MOST_IMAGES, "video": 1}, separators=(",", ":"))
    return " ".join([
        f"vllm serve {model.name}", "--host 127.0.0.1 --port 8000", f"--max-model-len {CONTEXT_TOKENS}",
        f"--limit-mm-per-prompt '{limit}'", "--enable-prefix-caching", *model.flags,
        *([f"--tensor-parallel-size {model.num_gpus}"] if model.num_gpus > 1 else []),
    ])


def set_options(model: ServedModel) -> list[str]:
    """Our settings for it, as options."""
    values = {"max_images": MOST_IMAGES, **model.settings}
    return [f"--judge.{name} {shlex.quote(json.dumps(value))}" for name, value in values.items()]


def _cost(rubric: Rubric) -> str:
    """What a clip costs where a stage is asked in one call."""
    static = 1 + profiles.STATIC_UNIFORM + profiles.NUM_BURSTS * profiles.BURST
    shown = static + profiles.INSTRUCTION_UNIFORM
    lines = [
        f"A clip by the rubric {rubric.name}: {2 + len(rubric.gated)} calls where every answer is clear, 2 where the "
        f"first gate closes at once. Each of {len(rubric.component_names)} components that is unclear adds 1 to "
        f"{rubric.voting.k_max - 1} calls of one letter. A call has at most {static} images (planning, VQ), {shown} "
        f"(IF), {shown + profiles.END_FRAMES + 1} (TC), {MOST_IMAGES} (PC, patterns).",
        f"Measured with scripted servers on 16 of the shipped clips, of 8 to 17 frames: {MEASURED[0][0]} to "
        f"{MEASURED[1][0]} calls and {MEASURED[0][1]} to {MEASURED[1][1]} images a clip; longer clips have more.",
    ]
    for size, tokens in IMAGE_TOKENS.items():
        low, high = (images * tokens + calls * TEXT_TOKENS for calls, images in MEASURED)
        lines.append(
            f"At {size} px that is about {tokens} tokens an image, {low:,} to {high:,} a clip, before the server's "
            "prefix cache (an estimate)."
        )
    return "\n".join(lines)


NOTES = """
Settings, as options above, or in the section judge of a preset:
  label_token_ids: ids of A to E, so that a letter's probability is known however small it is (vLLM 0.32 or later).
    Those of Qwen3-VL are given; of another model ask the server:
    curl 127.0.0.1:8000/tokenize -d '{"model": NAME, "prompt": "A", "add_special_tokens": false}'
  extra_body: sent with every request; here it turns thinking off, which our answers of 1 and 1,024 tokens do not allow.
  max_images: images per call; no more than --limit-mm-per-prompt allows.
  video: true sends the frames of PC and of the patterns as one video, two frames for the tokens of one image.
  call_plan: pack (default) asks a stage in one call; fanout pays only where the prefix cache works.
Not for this agent: RoboReward (answers "ANSWER: n") and Robometer (heads of its own, no chat).
Never run by us: every line above. vLLM 0.32 on a CPU took --max-model-len, --limit-mm-per-prompt and
--enable-prefix-caching with a tiny model of the Qwen3-VL kind; the memory is the sources', not measured here."""
