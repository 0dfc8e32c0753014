"""The shipped one-class judge on the shipped clips: what it keeps, what it refuses, and when it abstains (RA-27)."""

import asyncio
import functools
import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wm_nodes.config.load import load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.tasks import get_task
from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.agent.judge import JudgeError, Read, ReadRequest
from wm_nodes.judge.agent.levels import first_vote
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import ClipRef, Profile, Stage, Status, TaskSpec, clip_ref
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.backends import one_class
from wm_nodes.judge.backends.factory import check_judge, make_judge
from wm_nodes.judge.backends.one_class import OneClassJudge, ranges_of, unfit_reason
from wm_nodes.judge.check_set import LabelledClip, load_check_set
from wm_nodes.judge.one_class.calibration import words_of
from wm_nodes.judge.one_class.imagination import model_numbers
from wm_nodes.judge.one_class.pictures import HUES
from wm_nodes.judge.one_class.ranges import KEPT, file_of, load_ranges, save_ranges, strides_of
from wm_nodes.world_model.folder import read_world_manifest

FOLDER = shipped_model("push_cube")
MANIFEST = read_world_manifest(FOLDER)
RANGES = ranges_of(FOLDER, MANIFEST)


@functools.cache
def judge(conformal: float = 0.0) -> OneClassJudge:
    return OneClassJudge(FOLDER, conformal)


@functools.cache
def clips() -> list[LabelledClip]:
    return [clip for clip in load_check_set() if clip.truth.part == "policy"]


def clean() -> LabelledClip:
    """A recorded success."""
    return next(clip for clip in clips() if clip.truth.family == "clean" and clip.truth.success)


def judged(clip: ClipRef, task: TaskSpec, conformal: float = 0.0) -> Verdict:
    agent = RewardAgent(judge(conformal), load_rubric("robot"), mode="benchmark")
    return asyncio.run(agent.evaluate(clip, task))


def read(
    name: str, clip: ClipRef | None = None, task: TaskSpec | None = None, conformal: float = 0.0,
    stage: Stage = Stage.IF, votes: int = 1,
) -> list[Read]:
    """What the judge answers of one component of a clip, the clean one by default."""
    given = tuple(replace(first_vote(0), index=i) for i in range(votes))
    job = clean().job
    request = ReadRequest(clip or job.clip, task or job.task, stage, (name,), Profile.D, given, ())
    return asyncio.run(judge(conformal).read(request))


def told(instruction: str, **changes: str) -> TaskSpec:
    return replace(clean().job.task, instruction=instruction, **changes)


def of_frames(frames: UInt8Array, fps: float = 5.0) -> tuple[ClipRef, TaskSpec]:
    return clip_ref("c", frames, fps), replace(clean().job.task, reference_frame=frames[0])


def share_paid(chosen: Sequence[LabelledClip]) -> float:
    return float(np.mean([judged(clip.job.clip, clip.job.task).reward > 0.5 for clip in chosen]))


@pytest.mark.slow
def test_successes_are_mostly_paid_and_faults_mostly_not() -> None:
    clean_successes = [clip for clip in clips() if clip.truth.family == "clean" and clip.truth.success]
    benign = [clip for clip in clips() if clip.truth.family == "benign" and clip.truth.success]
    faults = [clip for clip in clips() if clip.truth.is_fault]
    assert len(clean_successes) > 8 and len(benign) > 8 and len(faults) > 25
    assert share_paid(clean_successes) > 0.8
    assert share_paid(benign) > 0.6
    assert share_paid(faults) < 0.4


@pytest.mark.parametrize(
    ("instruction", "reason"),
    [
        ("push the orange cube into the red target", "the orange cube is not in the first frame"),
        ("push the red cube into the red target", "the cube here is blue, not red"),
        ("push the blue cube into the blue target", "the target here is red, not blue"),
        ("push the blue cube into the target, green", "the green thing is not in the first frame"),
    ],
)
def test_a_wrong_colour_is_refused_and_named(instruction: str, reason: str) -> None:
    (answer,) = read("objective", task=told(instruction))
    assert answer.status is Status.OK and answer.levels[1] == 1 and reason in answer.evidence_text
    assert judged(clean().job.clip, told(instruction)).reward < 0.5


@pytest.mark.parametrize("instruction", ["push the blue ball into the red target", "dance", "pull the blue cube"])
def test_words_that_no_recording_had_are_not_judged(instruction: str) -> None:
    (answer,) = read("objective", task=told(instruction))
    assert answer.status is Status.ABSTAIN and "the recordings' instructions do not have" in answer.reason


def test_the_right_words_pass_with_other_punctuation() -> None:
    (answer,) = read("objective", task=told("Push the blue cube, into the red target."))
    assert answer.status is Status.OK and answer.levels[4] > 0.5


def test_completion_of_a_task_that_the_world_model_does_not_know_is_not_judged() -> None:
    (known,) = read("task_completion", stage=Stage.TC)
    (unknown,) = read("task_completion", task=replace(clean().job.task, task_id="fold_towel"), stage=Stage.TC)
    assert known.levels[4] > 0.5 and known.evidence_text.startswith("done signal ")
    assert unknown.status is Status.ABSTAIN and "not calibrated on task 'fold_towel'" in unknown.reason


def test_clips_of_another_size_length_or_reference_are_not_judged() -> None:
    frames = clean().job.clip.frames
    for shown, reason in (
        (frames[:, :, :64], "64 x 64 px, judged are 64 x 128 px"),
        (np.repeat(frames, 6, 0), f"{6 * len(frames)} frames, judged are 3 to "),
        (frames[:2], "2 frames, judged are 3 to "),
    ):
        verdict = judged(*of_frames(shown))
        assert verdict.status is Status.ABSTAIN and reason in verdict.reason and np.isnan(verdict.reward)
        assert reason in unfit_reason(RANGES, MANIFEST, shown.shape)
    other = replace(clean().job.task, reference_frame=frames[0, :, :64])
    verdict = judged(clean().job.clip, other)
    assert verdict.status is Status.ABSTAIN and "the reference frame is 64 x 64 px" in verdict.reason
    assert unfit_reason(RANGES, MANIFEST, frames.shape) == ""


def test_clips_of_a_frame_rate_without_ranges_are_not_judged_and_of_a_near_one_they_are() -> None:
    frames = clean().job.clip.frames
    for fps in (1e-6, 0.6, 30.0, 1e9):
        verdict = judged(*of_frames(frames, fps))
        assert verdict.status is Status.ABSTAIN and f"{fps:g} frames per second, judged are 5" in verdict.reason
    assert judged(*of_frames(frames, 6.0)).status is Status.OK


def test_every_vote_and_the_next_read_get_the_same_answer() -> None:
    first, again = read("interaction", votes=3), read("interaction", votes=3)
    assert [r.vote.index for r in first] == [0, 1, 2]
    assert {r.levels for r in (*first, *again)} == {first[0].levels}
    clip, task = clean().job.clip, clean().job.task
    assert judged(clip, task).audit_id == judged(clip, task).audit_id
    with pytest.raises(JudgeError, match="does not read sharpness"):
        read("sharpness")


def test_between_both_limits_a_conformal_judge_abstains_and_is_another_judge() -> None:
    names = ("clarity", "interaction", "robot", "temporal", "background", "geometry")
    answers = [
        (read(name, clip.job.clip, clip.job.task)[0], read(name, clip.job.clip, clip.job.task, 0.01)[0])
        for clip in clips()[:12] for name in names
    ]
    undecided = [(sure, careful) for sure, careful in answers if careful.status is Status.ABSTAIN]
    assert undecided and len(undecided) < len(answers)
    assert all(sure.levels[4] >= 0.5 and "stranger than 1% of" in careful.reason for sure, careful in undecided)
    assert all(sure.levels == careful.levels for sure, careful in answers if careful.status is Status.OK)
    assert judge(0.01).capabilities.judge_id == judge().capabilities.judge_id + "@0.01"
    with pytest.raises(ValueError, match=f"must be below {KEPT}, .* got 0.98"):
        check_judge(load_config("cpu", {"judge.kind": "embedded", "judge.conformal": 0.98}).judge)


@pytest.mark.parametrize("frames", [3, 9])
def test_every_clip_gets_an_answer(frames: int) -> None:
    rng = np.random.default_rng(0)
    shape = (frames, 64, 128, 3)
    grey, red = np.full(shape, 128, np.uint8), np.full(shape, np.uint8([220, 20, 20]))
    noise = rng.integers(0, 256, shape, np.uint8)
    for clip in (grey, red, noise, noise[::-1], np.flip(noise, 3)):
        verdict = judged(*of_frames(clip))
        assert verdict.status is Status.OK and 0 <= verdict.reward < 0.5, "nothing of this is a pushed cube"


def test_a_world_model_folder_with_ranges_is_a_judge_by_its_name_in_the_settings() -> None:
    settings = load_config("smoke", {"judge.kind": "embedded", "judge.folder": str(FOLDER)}).judge
    made = make_judge(settings, load_rubric()).judge
    assert isinstance(made, OneClassJudge) and made.capabilities == judge().capabilities
    assert "recordings" in made.card and "push_cube" in made.card


def test_a_folder_without_ranges_or_with_those_of_another_model_is_refused_with_the_command(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    shutil.copytree(FOLDER, folder, ignore=shutil.ignore_patterns("normal_ranges_2.json", "video_model*"))
    path = file_of(folder, 1)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"world_model": "0" * 64}))
    with pytest.raises(ModelFolderError, match="was made for another world model; make it anew: ") as other:
        OneClassJudge(folder)
    path.unlink()
    with pytest.raises(ModelFolderError, match="is missing; make it: ") as none:
        OneClassJudge(folder)
    for refused in (other, none):
        assert f"wm judge calibrate {folder} BAG --stride 1" in str(refused.value) and "\n" not in str(refused.value)


def test_other_ranges_of_any_stride_are_another_judge(tmp_path: Path) -> None:
    folder, names = tmp_path / "model", {judge().name}
    shutil.copytree(FOLDER, folder, ignore=shutil.ignore_patterns("video_model*"))
    assert len(strides_of(folder)) > 1 and OneClassJudge(folder).name in names
    for stride in strides_of(folder):
        save_ranges(folder, replace(load_ranges(folder, stride), height_m=0.5))
        names.add(OneClassJudge(folder).name)
    assert len(names) == 1 + len(strides_of(folder))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("part", [0, 1], ids=["number", "done"])
def test_a_number_that_is_not_finite_is_an_error_and_pays_nothing(
    monkeypatch: pytest.MonkeyPatch, value: float, part: int
) -> None:
    def spoiled(*given: Any) -> tuple[dict[str, float], dict[str, float]]:
        made = model_numbers(*given)
        made[part].update(dict.fromkeys(made[part], value))
        return made

    monkeypatch.setattr(one_class, "model_numbers", spoiled)
    agent = RewardAgent(OneClassJudge(FOLDER), load_rubric("robot"))
    verdict = asyncio.run(agent.evaluate(clean().job.clip, clean().job.task))
    assert verdict.status is Status.ERROR and math.isnan(verdict.reward) and "is not finite" in verdict.reason
    assert OneClassJudge(FOLDER).evidence(clean().job.clip, clean().job.task) == {}


@pytest.mark.parametrize("task", ["push_cube", "reach", "move_to_aim", "pick_place", "pull", "push", "reach_object"])
def test_a_shipped_judge_knows_the_words_and_the_completion_of_each_task_of_its_model(task: str) -> None:
    folder = shipped_model(task)
    for stride in strides_of(folder):
        ranges = load_ranges(folder, stride)
        known = {word for pair in ranges.words for word in pair.split()}
        assert set(words_of(get_task(task).instruction)) <= known | set(HUES) and task in ranges.done
