"""The embedded judge behind the agent: valid verdicts, gates, abstentions with reasons, equal hashes."""

import asyncio
import functools
from dataclasses import replace

import numpy as np
import pytest
import torch
from pushed_box import push_clip, redrawn

from wm_nodes.judge.agent.judge import JudgeError, Read, ReadRequest
from wm_nodes.judge.agent.levels import first_vote
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.rubric import Rubric, load_rubric
from wm_nodes.judge.agent.types import PLANNING, Profile, Stage, Status, TaskSpec, clip_ref
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.backends.embedded import EmbeddedJudge
from wm_nodes.judge.dataset.edits.clips import LabelledClip
from wm_nodes.judge.dataset.edits.recipes import apply, edit_states
from wm_nodes.judge.evidence.clip import clip_evidence
from wm_nodes.judge.evidence.head import HACK, Familiarity, HeadQuestion, JudgeHead, num_questions
from wm_nodes.judge.evidence.segmentation import Segmenter
from wm_nodes.judge.evidence.trees import Trees

RULES = {  # target: evidence below whose threshold it fails; everything else passes
    "clarity": ("sharpness_mean", 0.8), "brightness": ("gain_min", 0.7), "temporal": ("motion_mean", 0.05),
    "hack/motion": ("motion_mean", 0.05), "background": ("detail_mean", 0.7),
}


STORY = {"tasks": ["push_cube"]}


@functools.cache
def rubric() -> Rubric:
    return load_rubric()


@functools.cache
def segmenter() -> Segmenter:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Segmenter().eval()


@functools.cache
def clean() -> LabelledClip:
    return push_clip("expert")


def task_of(clip: LabelledClip) -> TaskSpec:
    return TaskSpec(clip.clip.instruction, "push_cube", "panda", clean().clip.frames[0])


@functools.cache
def head() -> JudgeHead:
    """One question per rule, written by hand on the evidence of the clean clip; distance is that from this clip."""
    found = clip_evidence(segmenter(), clean().clip.frames, clean().clip.frames[0], clean().clip.instruction)
    names, values = tuple(found), np.array(list(found.values()), np.float32)
    questions = {}
    for target in (*rubric().component_names, *(HACK + name for name in rubric().hack.patterns), PLANNING):
        name, threshold = RULES.get(target, (names[0], -np.inf))
        trees = Trees(
            np.array([[names.index(name)]], np.int32), np.array([[threshold]], np.float32),
            np.array([[-5.0, 5.0]], np.float32), np.ones((1, 1), np.float32), 0.0,
        )
        questions[target] = (HeadQuestion(trees, 1.0, 0.0),) * num_questions(target)
    known = Familiarity(values, np.abs(values) + 1, np.eye(len(names), dtype=np.float32), 1.15)
    return JudgeHead(
        segmenter(), names, questions, known, values - 0.1, values + 0.1, (96, 96), (12, 25), STORY, "a" * 64
    )


def judged(clip: LabelledClip, seed: int = 0, judge_head: JudgeHead | None = None) -> Verdict:
    agent = RewardAgent(EmbeddedJudge(judge_head or head()), rubric(), mode="benchmark", seed=seed)
    return asyncio.run(agent.evaluate(clip.ref, task_of(clip)))


def passed(verdict: Verdict) -> dict[str, bool]:
    return {score.component: score.passed for stage in verdict.stages for score in stage.components}


def test_a_clean_clip_gets_a_valid_verdict_in_which_everything_passes() -> None:
    verdict = judged(clean())
    assert verdict.valid and verdict.reward > 0.9 and verdict.level == 3 and all(passed(verdict).values())
    assert verdict.provenance.judge_id == "embedded:aaaaaaaaaaaa" and not any(f.confirmed for f in verdict.hack_flags)
    (read,) = [s.votes[0] for stage in verdict.stages for s in stage.components if s.component == "clarity"]
    assert read.source == "embedded" and read.levels == pytest.approx((0, 0.0067, 0, 0, 0.9933), abs=1e-4)
    assert "within what clean clips show" in read.evidence_text


@pytest.mark.parametrize(("recipe", "component"), [("blur", "clarity"), ("dark", "brightness")])
def test_a_defect_closes_its_gate_and_the_evidence_is_named(recipe: str, component: str) -> None:
    verdict = judged(apply(clean(), recipe, "fail", 0))
    assert verdict.valid and not passed(verdict)[component] and not verdict.stages[0].passed
    (text,) = [s.evidence_text for stage in verdict.stages for s in stage.components if s.component == component]
    assert RULES[component][0] in text and "clean" in text and len(text) <= 240


def test_a_frozen_clip_is_flagged_as_degraded_motion_and_the_flag_caps_completion() -> None:
    verdict = judged(apply(clean(), "freeze", "fail", 0))
    flags = {flag.pattern: flag.confirmed for flag in verdict.hack_flags}
    assert flags == {"occlusion": False, "motion": True, "background": False, "physics": False}
    (score,) = verdict.stages[2].components
    assert score.s == 0.25 and score.decided_by == "cap by motion"


def test_equal_seeds_give_equal_hashes_and_another_clip_another_one() -> None:
    teleported = redrawn(clean(), edit_states(clean(), "teleport", "fail", 0))
    assert judged(clean()).audit_id == judged(clean()).audit_id
    assert len({judged(clean()).audit_id, judged(clean(), seed=1).audit_id, judged(teleported).audit_id}) == 3


def shown(frames: np.ndarray, **task: object) -> Verdict:  # type: ignore[type-arg]
    spec = replace(task_of(clean()), reference_frame=frames[0], **task)  # type: ignore[arg-type]
    agent = RewardAgent(EmbeddedJudge(head()), rubric(), mode="reward")
    return asyncio.run(agent.evaluate(clip_ref("c", frames, 8.0), spec))


def test_foreign_clips_are_not_judged_and_the_reason_says_why() -> None:
    frames, rng = clean().clip.frames, np.random.default_rng(0)
    cases = {
        "unlike all training clips": rng.integers(0, 256, frames.shape, np.uint8),
        "64 x 96 px, judged are 96 x 96 px": frames[:, :64],
        "30 frames, judged are 12 to 25": np.concatenate([frames, frames])[:30],
    }
    for reason, clip in cases.items():
        verdict = shown(np.ascontiguousarray(clip))
        assert verdict.status is Status.ABSTAIN and np.isnan(verdict.reward) and reason in verdict.reason, reason
    verdict = shown(frames, instruction="fold the blue towel")
    assert verdict.status is Status.ABSTAIN and "no geometry for the task 'fold the blue towel'" in verdict.reason
    verdict = shown(frames, task_id="pull_cube")
    assert verdict.status is Status.ABSTAIN and "not trained on task 'pull_cube', only on push_cube" in verdict.reason


def test_a_component_that_was_measured_as_unseen_is_not_answered() -> None:
    measured = {"auroc": 0.6, "balanced_accuracy": 0.6, "ece": 0.0, "n": 9, "fails": 3}
    blind = replace(head(), story=STORY | {"validation": {"geometry": measured}})
    verdict = judged(clean(), judge_head=blind)
    assert verdict.status is Status.ABSTAIN and "does not see geometry" in verdict.reason
    assert "geometry" in (card := EmbeddedJudge(blind).card) and "not answered" in card


def test_where_both_answers_stay_possible_it_abstains_and_is_another_judge() -> None:
    """The hand-made heads say p_fail 0.0067 of what is clean and 0.9933 of what is not."""

    def at(low: float, high: float, recipe: str = "") -> Verdict:
        clip = apply(clean(), recipe, "fail", 0) if recipe else clean()
        unsure = replace(head(), story=STORY | {"conformal": {"clarity": {"0.9": [low, high]}}})
        agent = RewardAgent(EmbeddedJudge(unsure, 0.9), rubric(), mode="benchmark")
        return asyncio.run(agent.evaluate(clip.ref, task_of(clip)))

    sure = at(0.1, 0.05)
    assert sure.valid and sure.reward == judged(clean()).reward
    assert sure.provenance.judge_id == "embedded:aaaaaaaaaaaa@0.9"
    verdict = at(0.005, 0.0)
    assert verdict.status is Status.ABSTAIN and np.isnan(verdict.reward)
    assert "p_fail 0.007 leaves both possible at 90% coverage: clips that fail begin at 0.005" in verdict.reason
    assert passed(at(0.0, 0.99, "blur"))["clarity"] is False  # sure enough: clips that pass end at 0.99
    assert "clips that pass end at 0.995" in at(0.1, 0.995, "blur").reason
    with pytest.raises(ValueError, match="was not calibrated for this judge"):
        EmbeddedJudge(head(), 0.9)


def ask(request: ReadRequest) -> list[Read]:
    return asyncio.run(EmbeddedJudge(head()).read(request))


def test_every_vote_of_every_component_is_answered_alike_and_unknown_ones_are_errors() -> None:
    votes = (first_vote(0), replace(first_vote(0), index=1))
    request = ReadRequest(clean().ref, task_of(clean()), Stage.VQ, ("clarity", "color"), Profile.S, votes, ())
    reads = ask(request)
    assert [(read.component, read.vote.index) for read in reads] == [
        ("clarity", 0), ("clarity", 1), ("color", 0), ("color", 1)
    ]
    assert reads[0].levels == reads[1].levels and sum(read.cost.calls for read in reads) == 1
    with pytest.raises(JudgeError, match="no head for taste"):
        ask(replace(request, components=("clarity", "taste")))
    with pytest.raises(JudgeError, match="no evidence: the reference frame must be"):
        ask(replace(request, task=replace(task_of(clean()), reference_frame=clean().clip.frames[0, :50])))


def test_it_answers_again_from_what_it_measured_and_is_always_there() -> None:
    judge = EmbeddedJudge(head())
    first, second = (judge.evidence(clean().ref, task_of(clean())) for _ in range(2))
    assert first is second
    health = asyncio.run(judge.health())
    assert health.available and judge.capabilities.deterministic
