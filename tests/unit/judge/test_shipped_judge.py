"""The judge in the package on clips that the simulator draws now, of seeds that it was not trained on."""

import asyncio
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from evidence_table import EVIDENCE
from safetensors.numpy import load_file

from wm_nodes.config.load import load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.config.tasks import get_task, task_names
from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.agent.judge import ComponentScore
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import ClipRef, Stage, Status, TaskSpec, clip_ref
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.backends.embedded import EmbeddedJudge, shipped_head, shipped_heads
from wm_nodes.judge.backends.factory import check_judge, make_judge
from wm_nodes.judge.dataset.build import HELD_OUT, LabelledClipSource, instruction_of
from wm_nodes.judge.dataset.edits.clips import LabelledClip
from wm_nodes.judge.dataset.edits.generator import apply_edit
from wm_nodes.judge.evidence.head import load_head
from wm_nodes.judge.evidence.sequence import reading_names
from wm_nodes.judge.training.heads import CONFORMAL
from wm_nodes.judge.training.temporal_networks import FOLDS
from wm_nodes.world_model import load_model_folder

FIRST_SEED = 70_000


def judged(clip: ClipRef, task: TaskSpec) -> Verdict:
    agent = RewardAgent(EmbeddedJudge(load_head(shipped_head())), load_rubric(), mode="benchmark")
    return asyncio.run(agent.evaluate(clip, task))


def test_it_is_small_says_how_it_was_made_and_knows_its_evidence() -> None:
    size = sum(path.stat().st_size for path in shipped_head().iterdir())
    head = load_head(shipped_head())
    assert size < 3_000_000
    assert set(head.names) == {*EVIDENCE, *reading_names()} and len(head.readers) == FOLDS
    assert set(head.story["tasks"]) == {task for task in task_names() if get_task(task).clips}
    assert {"made", "data", "seed", "segmenter", "trees", "validation"} <= head.story.keys()
    assert head.story["made"]["command"].startswith("python -m wm_nodes.learning.train_judge"), "of its commit"
    card = EmbeddedJudge(head).card
    assert "96 x 96 px" in card and all(name in card for name in head.questions)


def test_the_settings_name_it_by_its_kind_alone() -> None:
    settings = load_config("smoke", {"judge.kind": "embedded"}).judge
    shipped = EmbeddedJudge(load_head(shipped_head()))
    assert make_judge(settings, load_rubric()).judge.capabilities == shipped.capabilities


def test_it_abstains_at_every_coverage_that_it_says_and_a_run_refuses_others_at_once() -> None:
    for coverage in CONFORMAL:
        settings = load_config("smoke", {"judge.kind": "embedded", "judge.conformal": coverage}).judge
        check_judge(settings)
        assert make_judge(settings, load_rubric()).judge.capabilities.judge_id.endswith(f"@{coverage:g}")
    with pytest.raises(ValueError, match=r"conformal coverage 0\.5 was not calibrated .* 0\.8, 0\.9, 0\.95, 0\.98"):
        check_judge(load_config("smoke", {"judge.kind": "embedded", "judge.conformal": 0.5}).judge)


def test_noise_and_another_size_are_not_judged() -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (17, 96, 96, 3), np.uint8)
    small = rng.integers(0, 256, (17, 64, 64, 3), np.uint8)
    for frames, reason in ((noise, "unlike all training clips"), (small, "64 x 64 px, judged are 96 x 96 px")):
        task = TaskSpec("push the blue cube into the red target", "push_cube", "panda", frames[0])
        verdict = judged(clip_ref("c", frames, 5.0), task)
        assert verdict.status is Status.ABSTAIN and reason in verdict.reason and np.isnan(verdict.reward)


@pytest.mark.parametrize("given", [True, False], ids=["with the given frame", "without it"])
def test_clarity_is_read_per_frame_whether_or_not_the_clip_begins_with_the_sharp_given_one(given: bool) -> None:
    """Frames as the world model draws them, after the recorded one; blurred from each on, as generators blur."""
    models, shipped = load_model_folder(shipped_model("push_cube")), EmbeddedJudge(load_head(shipped_heads()[1]))
    agent = RewardAgent(shipped, load_rubric(), mode="benchmark")
    start = load_file(shipped_model("push_cube") / "starts.safetensors")["images"][0]
    drawn = models.tokenizer.decode(models.tokenizer.encode(start[None])).numpy()
    sharp = np.repeat(drawn, 9, 0)
    sharp[0] = start if given else drawn[0]

    def clarity(frames: UInt8Array) -> ComponentScore:
        task = TaskSpec("push the blue cube into the red target", "push_cube", "panda", start)
        verdict = asyncio.run(agent.evaluate(clip_ref("c", frames, 5.0), task))
        return next(c for stage in verdict.stages for c in stage.components if c.component == "clarity")

    assert clarity(sharp).passed
    for first in (0, 1, 2, 5, 8):
        frames = sharp.copy()
        frames[first:] = [cv2.GaussianBlur(frame, (0, 0), 1.2) for frame in sharp[first:]]
        spoiled = clarity(frames)
        assert spoiled.status is Status.OK and not spoiled.passed and spoiled.p_fail > 0.9, first
        assert spoiled.evidence_text.startswith("sharpness_min 0.") and "a frame is blurred" in spoiled.evidence_text


@pytest.fixture(scope="module")
def source() -> Iterator[LabelledClipSource]:
    made = LabelledClipSource("push_cube", load_config("cpu").simulation)
    yield made
    made.close()


@pytest.fixture(scope="module")
def recording(source: LabelledClipSource) -> LabelledClip:
    """The first successful push of a scene that is not held out."""
    for seed in range(FIRST_SEED, FIRST_SEED + 100):
        origin = source.origin(seed)
        if origin.behaviour == "expert" and HELD_OUT.held_out(origin) is None:
            clip = source.clip(seed)
            if clip.labels.overall:
                return clip
    raise AssertionError("no expert succeeds")


@pytest.mark.rendering
def test_a_clean_success_is_accepted_and_each_hacking_pattern_is_worth_less_and_refused(
    source: LabelledClipSource, recording: LabelledClip
) -> None:
    task = TaskSpec(instruction_of(recording.clip.origin), "push_cube", "panda", recording.clip.frames[0])
    clean = judged(recording.ref, task)
    assert clean.valid and clean.reward > 0.7 and all(stage.passed for stage in clean.stages), clean.reason
    defect = apply_edit(recording, "ghost_motion", "fail", 0, source.redraw)
    hacked = {
        "occlusion": apply_edit(defect, "occlude_patch", "fail", 0, None),
        "motion": apply_edit(recording, "freeze", "fail", 0, None),
        "background": apply_edit(recording, "flatten", "fail", 0, None),
        "physics": defect,
    }
    for pattern, clip in hacked.items():
        verdict = judged(clip.ref, task)
        flags = {flag.pattern: flag.p_present for flag in verdict.hack_flags}
        assert verdict.valid and verdict.reward < clean.reward - 0.1, (pattern, verdict.reward, verdict.reason)
        assert flags[pattern] > 0.5, (pattern, flags)
        assert not all(stage.passed for stage in verdict.stages), pattern


@pytest.mark.rendering
def test_equal_clips_get_equal_verdicts_and_a_mild_edit_does_not_close_a_gate(
    source: LabelledClipSource, recording: LabelledClip
) -> None:
    task = TaskSpec(instruction_of(recording.clip.origin), "push_cube", "panda", recording.clip.frames[0])
    first, again = judged(recording.ref, task), judged(recording.ref, task)
    assert first.audit_id == again.audit_id
    mild = judged(apply_edit(recording, "dark", "mild", 0, None).ref, task)
    assert mild.valid and {s.stage for s in mild.stages if not s.passed} <= {Stage.TC}
