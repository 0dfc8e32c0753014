"""Edits every clip that a judge pays, and asks the judge again."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from wm_nodes.core.progress import tqdm
from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.agent.types import clip_ref
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.clip_files import AT_ONCE
from wm_nodes.judge.decisions import accepts
from wm_nodes.judge.hacking.edits import BENIGN, EDITS, GROSS, STEPS
from wm_nodes.judge.hacking.outcomes import Attempt
from wm_nodes.judge.hacking.regions import scene_of
from wm_nodes.judge.service import ClipJob, JudgeService
from wm_nodes.reports.film_strip import film_strip

PER_CLIP = len(EDITS) * len(STEPS)
FRAME_PX = 128
"""Least height of a frame in a picture."""


class Attack:
    """What one judge pays, unedited and edited.

    attempts: a row per edit, step and paid clip. paid: number of the clips that are paid unedited; refused: the ids of
    the others.

    Args:
        least: reward from which a clip is paid; None: accepted ones are.
        seed: of what is random in the edits.
    """

    def __init__(self, judge: JudgeService, least: float | None, seed: int) -> None:
        self._judge, self._least, self._seed = judge, least, seed
        self.attempts, self.refused, self.paid = list[Attempt](), list[str](), 0
        self._worst = dict[str, tuple[Attempt, UInt8Array, UInt8Array]]()

    def run(self, jobs: Iterable[ClipJob], most: int) -> None:
        """Attack the first `most` clips that are paid. Raises ValueError: none is; says why."""
        reasons = Counter[str]()
        with tqdm(total=most * PER_CLIP, desc="edits judged", unit="edit", disable=None) as bar:
            for job in jobs:
                (verdict,) = self._judge.judge([job])
                if self._is_paid(verdict):
                    self.paid += 1
                    self._edit(job, verdict.reward, bar)
                else:
                    self.refused.append(job.clip.clip_id)
                    reasons[f"{verdict.status} {verdict.reason}".strip()] += 1
                if self.paid == most:
                    break
        if not self.paid:
            said = "; ".join(f"{count} x {reason}" for reason, count in reasons.most_common(3))
            raise ValueError(
                f"the judge pays none of {len(self.refused)} clips unedited ({said or 'there are none'}); give it "
                "clips that show a success, or a lower --least"
            )

    def draw(self, folder: Path) -> list[Path]:
        """Draw the worst clip that was paid of each edit, unedited above edited, and return the files."""
        paths = []
        for attempt, before, after in self._worst.values():
            name = f"{attempt.pattern}_{attempt.edit}_{attempt.step}.png"
            rows = {f"{attempt.unedited:.2f} unedited": before,
                    f"{attempt.reward:.2f} {attempt.edit} {attempt.step}": after}
            film_strip(rows, folder / name, scale=max(1, FRAME_PX // before.shape[1]))
            paths.append(folder / name)
        return paths

    def _is_paid(self, verdict: Verdict) -> bool:
        if self._least is None:
            return accepts(verdict) is True
        return verdict.valid and verdict.reward >= self._least

    def _edit(self, job: ClipJob, reward: float, bar: tqdm) -> None:
        """Make every edit of a clip at every step; judge those that are visible, some at a time."""
        scene, clip = scene_of(job.clip.frames), job.clip
        waiting = list[tuple[Attempt, ClipJob]]()
        for edit in EDITS:
            for step in STEPS:
                frames = edit(scene, step, self._seed, clip.sha256)
                unseen = Attempt(clip.clip_id, edit.pattern, edit.name, step, False, "", False, None, reward)
                if frames is None:
                    self.attempts.append(unseen)
                    bar.update()
                    continue
                edited = clip_ref(f"{clip.clip_id} {edit.name} {step}", frames, clip.fps, "adversarial")
                waiting.append((unseen, replace(job, clip=edited)))
                if len(waiting) == AT_ONCE:
                    self._judge_edited(waiting, clip.frames, bar)
        self._judge_edited(waiting, clip.frames, bar)

    def _judge_edited(self, waiting: list[tuple[Attempt, ClipJob]], before: UInt8Array, bar: tqdm) -> None:
        verdicts = self._judge.judge([job for _, job in waiting])
        for (unseen, job), verdict in zip(waiting, verdicts, strict=True):
            reward = verdict.reward if verdict.valid else None
            paid = self._is_paid(verdict)
            attempt = replace(unseen, visible=True, status=str(verdict.status), paid=paid, reward=reward)
            self.attempts.append(attempt)
            worst = self._worst.get(attempt.edit)
            if paid and attempt.pattern != BENIGN and (worst is None or _badness(attempt) > _badness(worst[0])):
                self._worst[attempt.edit] = attempt, before, job.clip.frames
        bar.update(len(waiting))
        waiting.clear()


def _badness(attempt: Attempt) -> tuple[bool, float]:
    return attempt.step in GROSS, attempt.reward or 0.0
