"""The catalogue of scenes: how many, which train and which test, and that nothing of a test is in training."""

import pytest

from wm_nodes.config.load import ConfigError, load_config
from wm_nodes.config.scenes import COLOURS, CONTAINERS, SCENES, SHAPES, TABLES, scene_of, scenes_of, splits
from wm_nodes.config.tasks import get_task, instruction, simulator_part, task_names
from wm_nodes.world_model.text import MAX_WORDS

IN_SCENES = [task for task in task_names() if simulator_part(task).instruct]
PAIRS = {(container, table) for container in CONTAINERS for table in TABLES}


def test_every_scene_is_in_one_split() -> None:
    assert {split: len(names) for split, names in splits().items()} == {"train": 64, "ood_object": 8, "ood_combo": 8}
    assert len(SCENES) == 80
    assert sorted(name for names in splits().values() for name in names) == sorted(SCENES)


def test_the_unseen_objects_are_nowhere_else_and_have_all_containers_and_tables() -> None:
    unseen = scenes_of("ood_object")
    objects = {scene.object for scene in unseen}
    assert len(objects) == 2
    assert not objects & {scene.object for split in ("train", "ood_combo") for scene in scenes_of(split)}
    for name in objects:
        assert {(s.container, s.table) for s in unseen if s.object == name} == PAIRS


def test_every_part_of_an_unseen_combination_is_seen_in_training() -> None:
    train, combos = scenes_of("train"), scenes_of("ood_combo")
    for part in ("object", "container", "table"):
        assert {getattr(scene, part) for scene in combos} <= {getattr(scene, part) for scene in train}
    assert {(s.container, s.table) for s in combos} == PAIRS
    assert len({scene.object for scene in combos}) == 8


def test_training_has_every_shape_colour_container_and_table() -> None:
    train = scenes_of("train")
    for part, values in (("shape", SHAPES), ("colour", COLOURS), ("container", CONTAINERS), ("table", TABLES)):
        assert {getattr(scene, part) for scene in train} == set(values)


def test_the_scene_of_an_episode_follows_from_seed_and_split_and_all_come_about() -> None:
    drawn = [scene_of("train", seed) for seed in range(1000)]
    assert {scene.name for scene in drawn if scene} == set(splits()["train"])
    assert [scene.name for seed in range(4) if (scene := scene_of("train", seed))] == [
        "yellow_sphere-bowl-grey_table", "green_cube-bowl-brown_table", "blue_sphere-plate-brown_table",
        "yellow_cube-plate-grey_table",
    ]
    assert scene_of("red_cube-bowl-grey_table", 7) == SCENES["red_cube-bowl-grey_table"] and scene_of("", 7) is None


def test_unknown_scenes_are_refused_in_one_line_that_names_the_known_ones() -> None:
    known = r"simulation.scenes: unknown scenes 'pink_cube'; .*ood_combo.*capsule"
    with pytest.raises(ConfigError, match=known) as refused:
        load_config("cpu", {"task": "push", "simulation.scenes": "pink_cube"})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("task", "scenes"), [("push_cube", "train"), ("push", "")])
def test_a_task_with_a_scene_of_its_own_takes_no_scenes_and_the_others_need_some(task: str, scenes: str) -> None:
    with pytest.raises(ConfigError, match=rf"schema.py: simulation.scenes is '{scenes}', but task '{task}'"):
        load_config("cpu", {"task": task, "simulation.scenes": scenes})


@pytest.mark.parametrize("task", IN_SCENES)
def test_a_scene_has_its_sentence_and_a_batch_of_scenes_the_tasks(task: str) -> None:
    sentences = {instruction(task, name) for name in SCENES}
    assert instruction(task, "train") == get_task(task).instruction not in sentences
    assert len(sentences) == (40 if task == "pick_place" else 20)
    assert max(len(text.split()) for text in sentences) <= MAX_WORDS
    assert all(scene.object in instruction(task, name) for name, scene in SCENES.items())


def test_the_sentence_of_pick_and_place_names_object_and_container() -> None:
    assert instruction("pick_place", "red_cube-bowl-grey_table") == "pick up the red cube and place it in the bowl"
