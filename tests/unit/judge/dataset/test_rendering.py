"""Clips with known labels from the real simulator: recorded, drawn at 96 px, edited, drawn again."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from wm_nodes.apps.cli import main
from wm_nodes.config.load import load_config
from wm_nodes.config.tasks import clip_rules, get_task, success, task_names
from wm_nodes.environments.maniskill.environment import ManiSkillEnvironment
from wm_nodes.judge.dataset import rendering
from wm_nodes.judge.dataset.build import HELD_OUT, LabelledClipSource, SetPlan, build, scene_states
from wm_nodes.judge.dataset.edits.clips import BACKGROUND, DISTRACTOR, OBJECT, ROBOT
from wm_nodes.judge.dataset.edits.manifest import ManifestError, regenerate
from wm_nodes.judge.dataset.edits.recipes import edit_states
from wm_nodes.judge.dataset.edits.truth import failed_physics, tc_level
from wm_nodes.judge.dataset.rendering import CAMERAS, SceneAppearance, record_states
from wm_nodes.judge.dataset.set_files import check_set, clip_path, load_frames, load_set

pytestmark = pytest.mark.rendering
CONFIG = load_config("cpu").simulation


@pytest.fixture(scope="module")
def source() -> Iterator[LabelledClipSource]:
    made = LabelledClipSource("push_cube", CONFIG)
    yield made
    made.close()


def expert_seed(source: LabelledClipSource) -> int:
    return next(seed for seed in range(50) if source.origin(seed).behaviour == "expert")


def test_the_cube_is_nine_pixels_wide_and_its_track_is_on_it_in_every_camera(source: LabelledClipSource) -> None:
    clip = source.clip(expert_seed(source)).clip
    states = clip.states.at(np.array([0, len(clip) // 2]))
    for camera in CAMERAS:
        drawing = source.stage.draw(
            states.robot_q,
            states.poses,
            states.half_sizes_m * states.scales,
            states.tool,
            states.goal,
            camera,
            SceneAppearance(),
        )
        assert drawing.frames.shape == (2, 96, 96, 3)
        assert {BACKGROUND, ROBOT, OBJECT, DISTRACTOR} >= set(np.unique(drawing.masks)) >= {BACKGROUND, ROBOT, OBJECT}
        rows, columns = np.nonzero(drawing.masks[0] == OBJECT)
        assert np.ptp(columns) + 1 >= 9, camera
        assert drawing.tracks["object"][0] == pytest.approx([rows.mean(), columns.mean()], abs=3.0)


def test_held_out_places_are_rare_and_every_trained_one_is_common(source: LabelledClipSource) -> None:
    origins = [source.origin(seed) for seed in range(600)]
    for values, rare in (
        ([o.camera for o in origins], HELD_OUT.cameras),
        ([o.object_id for o in origins], HELD_OUT.objects),
        ([o.scene for o in origins], HELD_OUT.scenes),
    ):
        shares = {value: count / 600 for value, count in Counter(values).items()}
        assert all(shares[value] == pytest.approx(0.12, abs=0.04) for value in rare)
        assert all(share > 0.24 for value, share in shares.items() if value not in rare)


def test_an_expert_succeeds_and_a_clip_is_the_same_each_time(source: LabelledClipSource) -> None:
    seed = expert_seed(source)
    first = source.clip(seed)
    assert first.labels.overall and first.labels.tc_level == 4
    assert source.clip(seed).sha256 == first.sha256 != source.clip(seed + 1).sha256


def test_a_cube_that_the_simulator_knocked_ahead_passes_and_only_its_edits_fail(source: LabelledClipSource) -> None:
    knocked = source.clip(1018)
    states = knocked.clip.states
    cube_m, tool_m = (np.linalg.norm(np.diff(way, axis=0), axis=1) for way in (states.thing, states.tool))
    assert (cube_m - tool_m).max() > 0.04 and not failed_physics(states) and all(knocked.labels.components.values())
    sunk = source.redraw(knocked, edit_states(knocked, "sunk", "fail", 0)).labels
    assert [name for name, passed in sunk.components.items() if not passed] == ["geometry"]


def test_a_long_set_outlives_the_sixteen_bits_of_the_segmentation(
    source: LabelledClipSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, other = (source.clip(seed) for seed in (expert_seed(source), expert_seed(source) + 1))
    monkeypatch.setattr(rendering, "MAX_ID", 0)  # every drawing begins with a new scene
    for clip in (first, other):
        again = source.clip(clip.clip.origin.seed)
        assert again.sha256 == clip.sha256 and np.array_equal(again.clip.masks, clip.clip.masks)
    assert source.stage._last_id < 1000


def test_hovering_above_the_cube_is_success_of_reach_and_of_no_push() -> None:
    env = ManiSkillEnvironment("reach", CONFIG.model_copy(update={"image_size": 16}), end_on_success=False)
    states = scene_states(record_states(env, "hover", 1))
    env.close()
    levels = {task: tc_level(states, clip_rules(task).label) for task in task_names() if get_task(task).clips}
    assert levels["reach"] == 4 and levels["push_cube"] <= 1
    assert success("reach", env.ground_truth)[0]


def test_edited_states_are_drawn(source: LabelledClipSource) -> None:
    parent = source.clip(expert_seed(source))
    ghost = source.redraw(parent, edit_states(parent, "ghost_motion", "fail", 0))
    arm = ghost.clip.masks == ROBOT
    assert np.ptp(ghost.clip.states.robot_q, axis=0).max() == 0 and (arm.sum((1, 2)) > 0.5 * arm[0].sum()).all()
    assert not ghost.labels.components["interaction"] and ghost.labels.pattern == "physics"
    sunk = source.redraw(parent, edit_states(parent, "sunk", "fail", 0))
    assert (sunk.clip.masks[0] == OBJECT).sum() < 0.8 * (parent.clip.masks[0] == OBJECT).sum()
    double = source.redraw(parent, edit_states(parent, "second_copy", "fail", 0))
    assert (double.clip.masks[0] == OBJECT).sum() > 1.5 * (parent.clip.masks[0] == OBJECT).sum()


def test_one_command_builds_a_set_that_can_be_made_again(source: LabelledClipSource, tmp_path: Path) -> None:
    plan = SetPlan(num_episodes=2, edits_per_clip=8, seed=3, stacks_per_clip=2)
    manifest, skipped = build(tmp_path, plan, CONFIG, progress=False)
    assert load_set(tmp_path) == manifest and 2 + 8 < len(manifest.rows) <= 2 + 2 * (8 + 2) - sum(skipped.values())
    assert max(len(row.edits) for row in manifest.rows) > 2
    roots = {clip.sha256: clip for clip in (source.clip(3), source.clip(4))}
    for row in manifest.rows:
        clip = regenerate(row, roots[row.root], source.redraw)
        assert clip.clip.frames.tobytes() == load_frames(tmp_path, row.sha256).tobytes()
    assert check_set(tmp_path) == manifest
    assert Counter(row.root == row.sha256 for row in manifest.rows)[True] == 2
    with pytest.raises(FileExistsError, match="take a new folder"):
        build(tmp_path, plan, CONFIG, progress=False)
    first, second = (clip_path(tmp_path, row.sha256) for row in manifest.rows[:2])
    first.write_bytes(second.read_bytes())
    with pytest.raises(ManifestError, match="holds another clip than its name says"):
        check_set(tmp_path)
    first.write_bytes(second.read_bytes()[:900])
    assert main(["build-judge-dataset", str(tmp_path), "--check"]) == 2
    first.unlink()
    with pytest.raises(ManifestError, match=r"cannot be read: .*; build the set again"):
        check_set(tmp_path)
