"""Audit logs for tests: clips that scripted judges have judged."""

import asyncio
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scripted_judge import ScriptedJudge, make_clip, make_task

from wm_nodes.judge.agent.judge import Capabilities, Health, Judge, Read, ReadRequest
from wm_nodes.judge.agent.rubric import Rubric, load_rubric
from wm_nodes.judge.agent.types import ClipRef, Evidence, TaskSpec, clip_ref
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.audit.log import AuditLog
from wm_nodes.judge.audit.recording import AuditedAgent

Job = tuple[ClipRef, TaskSpec]


def clips(count: int) -> list[Job]:
    """Noise of 8 x 8 pixels; other clips for other numbers."""
    made = [make_clip(seed, num_frames=6) for seed in range(count)]
    return [(clip, make_task(clip)) for clip in made]


def moving_squares(count: int, num_frames: int = 25, side_px: int = 96) -> list[Job]:
    """A coloured square that is pushed over a grey table: something to look at."""
    jobs = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        colour, row, speed = rng.integers(60, 256, 3), int(rng.integers(20, 60)), rng.uniform(0.5, 2.5)
        frames = np.full((num_frames, side_px, side_px, 3), 150, np.uint8)
        frames[:, side_px // 2 :] = 120
        for t, frame in enumerate(frames):
            left = int(8 + speed * t)
            frame[row : row + 12, left : left + 12] = colour
        clip = clip_ref(f"square {seed}", frames, 10.0)
        jobs.append((clip, TaskSpec("push the square to the right", "push_square", "panda", frames[0], frames[-1])))
    return jobs


class JudgeByClip:
    """Hands each clip to a judge of its own. judges: by clip id."""

    def __init__(self, judges: Mapping[str, ScriptedJudge]) -> None:
        self._judges = judges

    @property
    def capabilities(self) -> Capabilities:
        return next(iter(self._judges.values())).capabilities

    async def health(self) -> Health:
        return Health(True)

    async def read(self, request: ReadRequest) -> list[Read]:
        return await self._judges[request.clip.clip_id].read(request)


def judge_all(
    folder: Path, judge: Judge, jobs: Sequence[Job], *, rubric: Rubric | None = None,
    evidence: Mapping[str, Evidence] | None = None, **settings: Any,
) -> list[Verdict]:
    """Judge clips at the same time into a log, which may be there already. evidence: by clip id."""

    async def run() -> list[Verdict]:
        with AuditLog(folder) as log:
            agent = AuditedAgent(judge, rubric or load_rubric("robot"), log, **settings)
            known = evidence or {}
            return list(await asyncio.gather(*(agent.evaluate(c, task, known.get(c.clip_id)) for c, task in jobs)))

    return asyncio.run(run())
