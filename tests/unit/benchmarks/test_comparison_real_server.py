"""Comparison rewards and PAI-Bench questions against software that we did not write: a local folder of weights behind
`transformers serve`, as the weights of UnifiedReward would be.
"""

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_vlm import save_tiny_vlm, transformers_serve

from benchmarks.judge.comparisons import pai_bench as pai
from benchmarks.judge.comparisons.chat import ChatComparison
from benchmarks.judge.comparisons.protocols import POINTWISE
from wm_nodes.judge.agent.types import TaskSpec, clip_ref
from wm_nodes.judge.backends.transport import ChatTransport, Endpoint

pytestmark = pytest.mark.slow

FRAMES = np.random.default_rng(0).integers(0, 256, (12, 24, 32, 3), np.uint8)
CLIP, TASK = clip_ref("one", FRAMES, 8.0), TaskSpec("push the red cube", "push", "panda", FRAMES[0])
QUESTION = pai.BenchQuestion("q", "robot_1", "Is the cube moved?", "no", "space")


def test_a_score_comes_from_a_folder_of_weights_and_other_protocols_refuse_its_answer(tmp_path: Path) -> None:
    pytest.importorskip("fastapi", reason="transformers serve needs fastapi and uvicorn of requirements/dev.txt")
    save_tiny_vlm(tmp_path, '{"score": 7}')

    async def run(url: str) -> tuple[Any, Any, Any]:
        transport = ChatTransport([Endpoint(url, str(tmp_path))])
        try:
            judge = ChatComparison(transport, max_tokens=16)
            good = await judge.score(POINTWISE["single"], CLIP, TASK)
            other = await judge.score(POINTWISE["videoalign"], CLIP, TASK)
            return good, other, await pai.answer(judge, QUESTION, CLIP)
        finally:
            await transport.close()

    with transformers_serve(tmp_path) as url:
        good, other, answered = asyncio.run(run(url))
    assert good.valid and good.value == 0.7 and good.cost.images == 8 and good.cost.prompt_tokens > 0
    assert not other.valid and "VQ: Field required" in other.reason and other.cost.calls == 2
    assert answered.said is None and not answered.right and "either yes or no" in answered.reason
