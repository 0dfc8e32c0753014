"""Clips as the loops see them: the same pictures as the environment's, drawn or decoded, and cut where episodes end."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from wm_nodes.config.load import load_config
from wm_nodes.config.tasks import clip_rules, get_task
from wm_nodes.core.types import UInt8Array
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import TaskSpec, clip_ref
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.backends.embedded import EmbeddedJudge, shipped_heads
from wm_nodes.judge.dataset.build import SIDE_PX, LabelledClipSource, SetPlan
from wm_nodes.judge.dataset.edits.clips import OBJECT
from wm_nodes.judge.dataset.edits.truth import tc_level
from wm_nodes.judge.dataset.policy_camera import (
    DECODED,
    DRAWN,
    IMAGINED,
    SHORTEST,
    PolicyCamera,
    policy_models,
    policy_window,
)
from wm_nodes.judge.evidence.head import load_head
from wm_nodes.judge.evidence.window import Window
from wm_nodes.world_model import load_model_folder

CONFIG = load_config("cpu").simulation


@pytest.fixture(scope="module")
def view() -> PolicyCamera:
    return PolicyCamera(load_model_folder(policy_models(Path())), SIDE_PX)


@pytest.fixture(scope="module")
def source(view: PolicyCamera) -> Iterator[LabelledClipSource]:
    made = LabelledClipSource("push_cube", CONFIG, policy=view)
    yield made
    made.close()


def seeds_of(view: PolicyCamera, kind: str) -> list[int]:
    """Of experts whose clips are of a kind."""
    origins = [view.origin("push_cube", seed) for seed in range(200)]
    return [o.seed for o in origins if o.scene.split(" by ")[0] == kind and o.behaviour == "expert"]


def first_picture(seed: int) -> UInt8Array:
    env = ManiSkillEnvironment("push_cube", CONFIG)
    try:
        return env.reset(seeds=np.array([seed], np.uint64)).image[0]
    finally:
        env.close()


def test_a_window_shows_its_columns_at_its_size_and_moves_masks_and_tracks_with_them() -> None:
    window = Window(height=64, width=128, first=64, end=128, side=96)
    pictures = np.zeros((2, 64, 128, 3), np.uint8)
    pictures[:, 10:20, 64 + 30 : 64 + 40] = 200
    seen = window.pictures(pictures)
    assert seen.shape == (2, 96, 96, 3) and seen.dtype == np.uint8
    assert np.array_equal(window.pictures(pictures[0]), seen[0])
    masks = window.masks((pictures[:, :, 64:, 0] > 0).astype(np.uint8))
    rows, columns = np.nonzero(masks[0])
    track = window.track(np.array([[14.5, 34.5]], np.float32))[0]
    assert (rows.mean(), columns.mean()) == pytest.approx(tuple(track), abs=0.5)
    bright = np.argwhere(seen[0, :, :, 0] > 100)
    assert bright.mean(0) == pytest.approx(track, abs=0.5)


def test_a_window_refuses_pictures_of_another_size() -> None:
    with pytest.raises(ValueError, match=r"64 x 128 px of 3 colours, got .*96, 96"):
        Window(64, 128, 0, 64, 96).pictures(np.zeros((96, 96, 3), np.uint8))


def test_the_window_of_the_loops_is_the_side_camera_wherever_it_stands() -> None:
    assert policy_window(CONFIG, 96) == Window(64, 128, 0, 64, 96)
    turned = CONFIG.model_copy(update={"cameras": ["wrist", "side"]})
    assert policy_window(turned, 96) == Window(64, 128, 64, 128, 96)
    with pytest.raises(ValueError, match="reads the camera side, there are wrist"):
        policy_window(CONFIG.model_copy(update={"cameras": ["wrist"]}), 96)


@pytest.mark.rendering
def test_a_drawn_clip_begins_with_the_picture_that_the_environment_shows(
    source: LabelledClipSource, view: PolicyCamera
) -> None:
    seed = seeds_of(view, DRAWN)[0]
    clip = source.clip(seed).clip
    shown = policy_window(CONFIG, SIDE_PX).pictures(first_picture(seed))
    assert np.abs(clip.frames[0].astype(int) - shown).mean() < 0.5
    row, column = clip.tracks["object"][0]
    assert clip.masks[0, round(float(row)), round(float(column))] == OBJECT


@pytest.mark.rendering
def test_of_a_decoded_clip_all_pictures_but_the_first_have_gone_through_the_tokenizer(
    source: LabelledClipSource, view: PolicyCamera
) -> None:
    seed, window = seeds_of(view, DECODED)[0], policy_window(CONFIG, SIDE_PX)
    clip, shown = source.clip(seed).clip, first_picture(seed)
    assert clip.origin.scene == f"{DECODED} by {view.models.sha256[:12]}"
    assert np.abs(clip.frames[0].astype(int) - window.pictures(shown)).mean() < 0.5
    decoded = window.pictures(view.models.tokenizer.decode(view.models.tokenizer.encode(shown[None])).numpy())[0]
    still = np.s_[40:56, 40:56]  # where nothing moves before the third frame
    apart = [np.abs(clip.frames[t][still].astype(int) - decoded[still]).mean() for t in (0, 1)]
    assert apart[1] < 4 and apart[1] < 0.6 * apart[0], f"decoding shows: {apart}"


@pytest.mark.rendering
def test_an_imagined_clip_is_the_models_own_where_it_stays_with_the_simulator_and_else_is_decoded(
    source: LabelledClipSource, view: PolicyCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    seed = seeds_of(view, IMAGINED)[0]
    monkeypatch.setattr("wm_nodes.judge.dataset.policy_camera.NEAR_M", {"object": 1.0, "tool": 1.0})
    imagined = source.clip(seed).clip
    monkeypatch.setattr("wm_nodes.judge.dataset.policy_camera.NEAR_M", {"object": 1e-9, "tool": 1.0})
    decoded = source.clip(seed).clip
    assert imagined.origin.scene == f"{IMAGINED} by {view.models.sha256[:12]}"
    assert decoded.origin.scene == f"{DECODED} by {view.models.sha256[:12]}"
    apart = np.abs(imagined.frames.astype(int) - decoded.frames).mean((1, 2, 3))
    assert apart[0] == 0 and apart[1:].min() > 0 and apart.max() < 20


@pytest.mark.rendering
def test_successes_are_cut_at_their_end_or_go_on_and_failures_are_whole(
    source: LabelledClipSource, view: PolicyCamera
) -> None:
    rule, cut = clip_rules("push_cube").label, 0
    for seed in [s for s in range(40) if view.origin("push_cube", s).behaviour in ("expert", "short")][:6]:
        states = source.clip(seed).clip.states
        levels = [tc_level(states.at(np.arange(end)), rule) for end in range(1, len(states) + 1)]
        whole = len(states) == CONFIG.max_episode_steps + 1
        cut += not whole
        assert len(states) >= SHORTEST
        assert whole or (levels[-1] == 4 and levels[:-1].count(4) <= 1)
    assert 0 < cut < 6


def test_the_loops_have_one_look_and_the_cube_alone() -> None:
    with pytest.raises(ValueError, match="leave out diverse and shapes"):
        SetPlan(policy=True, diverse=True, development=True)
    with pytest.raises(ValueError, match="leave out diverse and shapes"):
        SetPlan(policy=True, shapes=("post",))


@pytest.mark.rendering
def test_the_shipped_judge_of_these_pictures_pays_a_success_more_than_what_only_ends_like_one(
    source: LabelledClipSource, view: PolicyCamera
) -> None:
    clips = (source.clip(seed) for seed in seeds_of(view, DRAWN))
    states = next(clip.clip.states for clip in clips if clip.labels.overall and len(clip.clip) > 8)
    _, pictures = view.render(source.stage, states)
    task = TaskSpec(get_task("push_cube").instruction, "push_cube", "panda", pictures[0])
    cut = np.concatenate([pictures[:1].repeat(len(pictures) - 1, 0), pictures[-1:]])  # the end, and nothing before it

    def verdict(frames: UInt8Array) -> Verdict:
        judge = EmbeddedJudge(load_head(shipped_heads()[1]))
        return asyncio.run(RewardAgent(judge, load_rubric()).evaluate(clip_ref("c", frames, CONFIG.control_hz), task))

    good, frozen, jumped = verdict(pictures), verdict(pictures[:1].repeat(len(pictures), 0)), verdict(cut)
    assert good.valid and good.reward > 0.8 and all(stage.passed for stage in good.stages), good.reason
    for other in (frozen, jumped):
        assert other.valid and other.reward < good.reward - 0.2, other.reason
