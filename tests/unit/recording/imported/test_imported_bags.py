"""Plain bags become ours: what is seen at a tick, what is commanded until the next, where episodes begin and end."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from foreign_robot import (
    BEGIN_NS,
    EXAMPLE,
    FRONT,
    JOINTS,
    MS,
    TWIST,
    Message,
    Run,
    compressed,
    contract_file,
    flag,
    header,
    image,
    joint_state,
    message,
    numbers,
    twist,
    write,
)
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from wm_nodes.apps.cli import main
from wm_nodes.config.load import load_config
from wm_nodes.core.specs import SOURCE_REAL
from wm_nodes.core.types import TRY, Episode
from wm_nodes.policy_rl.pretraining import model_from_data, read_recordings
from wm_nodes.recording import Bag, BagError, RawBagWriter, read_episodes, read_spec
from wm_nodes.recording.episode_arrays import stack_episodes
from wm_nodes.recording.imported import load_contract, survey
from wm_nodes.recording.imported import write as write_import
from wm_nodes.recording.imported.contract import Camera
from wm_nodes.recording.imported.numbers import Selector
from wm_nodes.recording.imported.pictures import ENCODINGS, fitted, rgb_of
from wm_nodes.world_model import load_model_folder

FORMATS = [
    (StoragePlugin.MCAP, CompressionMode.NONE), (StoragePlugin.MCAP, CompressionMode.FILE),
    (StoragePlugin.SQLITE3, CompressionMode.NONE), (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
]
TINY = {
    "task": "", "tokenizer.width": 32, "tokenizer.patch_px": 8, "tokenizer.num_iterations": 4,
    "tokenizer.decoder_iterations": 0, "tokenizer.probe_iterations": 0, "world_model.width": 32,
    "world_model.num_iterations": 4, "world_model.batch_size": 4, "world_model.rollout_steps": [2],
    "reward.dense_weight": 0.0,
}


def imported(bags: list[Path], contract: Path, out: Path) -> list[Episode]:
    write_import(survey(bags, load_contract(contract)), out)
    return list(read_episodes(out))


def one_topic(path: Path, messages: list[Message], **changes: Any) -> list[Episode]:
    """The episodes of a bag of one camera, a state and a command, which is one episode."""
    write(path / "bag", messages)
    (path / "labels.csv").write_text("bag,start_s,end_s,success\nbag,,,1\n")
    fixed = {
        "timeline": "header", "observations__images__wrist": None, "observations__state__1": None, "actions__1": None,
        "probes": None,
        "episodes__split": {"per": "bag"}, "episodes__success": {"file": "labels.csv"}, "episodes__min_steps": 1,
    }
    return imported([path / "bag"], contract_file(path / "contract.yaml", **{**fixed, **changes}), path / "out")


def stream(steps: int, step_ms: int = 100, *, commands: Any = None, until: int | None = None) -> list[Message]:
    """Every `step_ms`: a picture and a joint that count the steps, and a command 20 ms later."""
    listed = list[Message]()
    for step in range(steps):
        now = BEGIN_NS + step * step_ms * MS
        picture = np.full((64, 64, 3), step, np.uint8)
        listed += [(now, FRONT, compressed(now, picture, "png")), (now, JOINTS, joint_state(now, j1=step, j2=0.0))]
        if until is None or step < until:
            x, y = commands(step) if commands else (0.01 * (step % 10), 0.0)
            listed.append((now + 20 * MS, TWIST, twist(now + 20 * MS, x, y)))
    return listed


@pytest.mark.parametrize(("plugin", "mode"), FORMATS)
def test_a_plain_bag_of_any_format_gives_the_same_episodes(
    tmp_path: Path, plugin: StoragePlugin, mode: CompressionMode, capsys: pytest.CaptureFixture[str]
) -> None:
    Run(3).write(tmp_path / "plain")
    Run(3).write(tmp_path / "other", plugin, mode)
    (ours, theirs) = ([*imported([tmp_path / name], EXAMPLE, tmp_path / f"{name}_out")] for name in ("plain", "other"))
    assert len(ours) == 3 and [bool(episode.success[-1]) for episode in ours] == [True, False, True]
    assert [episode.terminated for episode in ours] == [True, False, True]
    assert [episode.truncated for episode in ours] == [False, True, False]
    for one, same in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one.images, same.images)
        np.testing.assert_array_equal(one.actions, same.actions)
    capsys.readouterr()


def test_a_bag_that_was_split_into_files_gives_the_same_episodes(tmp_path: Path) -> None:
    plain = Run(2).write(tmp_path / "plain")
    with Bag(plain) as bag, RawBagWriter(tmp_path / "parts", chunk_bytes=20_000, split_bytes=20_000) as writer:
        for connection in bag.connections:
            writer.copy_topic(connection)
        for topic, time_ns, data in bag.messages():
            writer.write(topic, data, time_ns)
    assert len([*(tmp_path / "parts").glob("*.mcap")]) > 2
    ours, theirs = (imported([tmp_path / name], EXAMPLE, tmp_path / f"{name}_out") for name in ("plain", "parts"))
    for one, same in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one.images, same.images)
        np.testing.assert_array_equal(one.states, same.states)


@pytest.mark.slow
def test_a_foreign_bag_becomes_a_world_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bags = [str(Run(4, seed=seed).write(tmp_path / f"run_{seed}")) for seed in range(2)]
    out = tmp_path / "ours"
    assert main(["import", "rosbag", str(EXAMPLE), *bags, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "bags: 2; episodes: 8, 4 of them end in success; steps: 160 of 100 ms" in printed
    spec, episodes = read_spec(out), list(read_episodes(out))
    assert (spec.cameras, spec.height, spec.width, spec.source) == (("front", "wrist"), 64, 128, SOURCE_REAL)
    assert spec.state_names == ("position.j1", "position.j2", "gripper.width") and spec.measured == (0, 1, 2)
    assert spec.action_scale == pytest.approx((0.1, 0.1, 0.04)) and spec.control_period_s == 0.1
    assert spec.max_episode_steps == 20 and spec.ground_truth_names == ("pose.position.x", "pose.position.y")
    assert {episode.instruction for episode in episodes} == {"pick up the cup"}
    with Bag(out) as bag:
        assert "lab/my_arm" in bag.custom["wm.contract_yaml"] and "images.front" in bag.custom["wm.import_table"]
    arrays = stack_episodes(episodes, (spec.task,), num_steps=spec.max_episode_steps)
    assert arrays.images.shape == (8, 21, 64, 128, 3)
    np.testing.assert_array_equal(arrays.ground_truth, arrays.states[..., :2])  # the cup is where the joints are
    assert arrays.success[:, -1, 0].tolist() == [True, False] * 4
    torch.set_num_threads(1)
    config = load_config("smoke", TINY)
    folder = model_from_data(*read_recordings([out], config), config, tmp_path / "model")
    models = load_model_folder(folder)
    assert models.tasks == ("pick_up_the_cup",) and models.spec.cameras == ("front", "wrist")


def test_an_observation_is_the_newest_at_or_before_its_tick_and_an_action_what_was_commanded_until_the_next(
    tmp_path: Path,
) -> None:
    (episode,) = one_topic(tmp_path, stream(6))
    assert episode.images[:, 0, 0, 0].tolist() == [0, 1, 2, 3, 4, 5]
    np.testing.assert_array_equal(episode.states[:, 0], [0, 1, 2, 3, 4, 5])
    # a command comes 20 ms after the tick: until then the one before holds
    np.testing.assert_allclose(episode.actions[:, 0], [0, 0.08, 0.18, 0.28, 0.38], atol=1e-6)


def test_an_action_explains_the_change_of_its_step_and_not_that_of_the_step_beside_it(tmp_path: Path) -> None:
    episodes = imported([Run(4, seed=3).write(tmp_path / "bag")], EXAMPLE, tmp_path / "out")
    moved = np.concatenate([np.diff(episode.states[:, 0])[1:-1] for episode in episodes])

    def correlation(lag: int) -> float:
        actions = [np.roll(episode.actions[:, 0], lag)[1:-1] for episode in episodes]
        return float(np.corrcoef(moved, np.concatenate(actions))[0, 1])

    assert correlation(0) > 0.99 and abs(correlation(1)) < 0.5 and abs(correlation(-1)) < 0.5


def test_a_picture_that_comes_after_its_tick_is_not_seen_at_it(tmp_path: Path) -> None:
    def late(time_ns: int, topic: str, one: Any) -> Message:
        later = time_ns + 30 * MS * (topic == FRONT and time_ns > BEGIN_NS)
        if topic == FRONT:
            one.header.stamp.nanosec += 30 * MS * (time_ns > BEGIN_NS)
        return later, topic, one

    (episode,) = one_topic(tmp_path, [late(*each) for each in stream(6)])
    assert episode.images[:, 0, 0, 0].tolist() == [0, 0, 1, 2, 3, 4]


def test_of_several_commands_in_a_step_the_mean_over_time_or_the_last_counts(tmp_path: Path) -> None:
    messages = stream(5, commands=lambda step: (0.02, 0.0))
    again = [(now, TWIST, twist(now, 0.06, 0.0)) for now in range(BEGIN_NS + 70 * MS, BEGIN_NS + 500 * MS, 100 * MS)]
    expect: dict[str, list[float]] = {"mean": [0.35, 0.4, 0.4, 0.4], "last": [0.6] * 4}
    for resample, expected in expect.items():
        folder = tmp_path / resample
        folder.mkdir()
        (episode,) = one_topic(folder, messages + again, actions__0__resample=resample)
        np.testing.assert_allclose(episode.actions[:, 0], expected, atol=1e-6)


def with_targets(targets: list[tuple[float, float]], messages: list[Message]) -> list[Message]:
    """Commands to j1 and j2 in place of velocities, 20 ms after each tick."""
    def target(time_ns: int, j1: float, j2: float) -> Message:
        duration = message("builtin_interfaces/msg/Duration", sec=0, nanosec=0)
        point = message("trajectory_msgs/msg/JointTrajectoryPoint", positions=np.array([j2, j1]),
                        velocities=np.zeros(0), accelerations=np.zeros(0), effort=np.zeros(0), time_from_start=duration)
        return time_ns, TWIST, message("trajectory_msgs/msg/JointTrajectory", header=header(time_ns),
                                       joint_names=["j2", "j1"], points=[point])

    return [each for each in messages if each[1] != TWIST] + [
        target(BEGIN_NS + (100 * step + 20) * MS, j1, j2) for step, (j1, j2) in enumerate(targets)
    ]


TARGETS = {"topic": TWIST, "type": "trajectory_msgs/msg/JointTrajectory", "select": ["position.j1", "position.j2"],
           "unit": "rad", "low": [-1, -1], "high": [1, 1], "resample": "last", "relative_to": "state"}


def test_a_target_of_joints_may_count_as_the_change_from_the_state(tmp_path: Path) -> None:
    (episode,) = one_topic(tmp_path, with_targets([(step + 0.25, 0.5) for step in range(5)], stream(5)),
                           actions__0=TARGETS)
    np.testing.assert_allclose(episode.actions, [[0.25, 0.5]] * 4, atol=1e-6)


def test_a_change_of_an_angle_is_the_shorter_way_round_and_that_of_a_length_is_as_commanded(tmp_path: Path) -> None:
    messages = with_targets([(step + 0.25 - 2 * np.pi, 2 * np.pi - 0.5) for step in range(5)], stream(5))
    for unit, limits in ({"rad": [1, 1], "m": [10, 10]}).items():
        folder = tmp_path / unit
        folder.mkdir()
        changes = {"unit": unit, "low": [-limit for limit in limits], "high": limits}
        (episode,) = one_topic(folder, messages, actions__0={**TARGETS, **changes})
        expected = [0.25, -0.5] if unit == "rad" else [0.025 - np.pi / 5, np.pi / 5 - 0.05]
        np.testing.assert_allclose(episode.actions, [expected] * 4, atol=1e-6)


def test_a_stretch_with_a_gap_is_lost_and_counted_and_nothing_is_filled(tmp_path: Path) -> None:
    def has_camera(time_ns: int) -> bool:
        return not BEGIN_NS + 800 * MS <= time_ns < BEGIN_NS + 1300 * MS

    messages = [each for each in stream(24) if each[1] != FRONT or has_camera(each[0])]
    episodes = one_topic(tmp_path, messages)
    shown = [episode.images[:, 0, 0, 0].tolist() for episode in episodes]
    assert shown == [[*range(8), 7], [*range(13, 24)]]  # picture 7 is 100 ms old at the next tick, of 150 allowed
    assert [bool(episode.success[-1]) for episode in episodes] == [False, True]
    report = survey([tmp_path / "bag"], load_contract(tmp_path / "contract.yaml"))
    assert report.tally.missing["images.front"] == 4
    assert "0.60 s in bag at 0.7 s" in report.table()
    assert "left out: 5 steps in gaps and short stretches" in report.table()


def test_the_stretches_of_one_try_carry_its_number(tmp_path: Path) -> None:
    def gaps(messages: list[Message]) -> list[Message]:
        begins = [time_ns for time_ns, topic, one in messages if topic == "/episode" and one.data]
        return [(time_ns, topic, one) for time_ns, topic, one in messages if topic != FRONT or not any(
            begin + 800 * MS <= time_ns < begin + 1300 * MS for begin in begins[:1]
        )]

    bags = [Run(2, change=gaps).write(tmp_path / day / "bag") for day in ("monday", "tuesday")]
    episodes = imported(bags, EXAMPLE, tmp_path / "out")
    assert [episode.extra[TRY] for episode in episodes] == [1, 1, 2, 3, 3, 4]
    assert "bags: 2; episodes: 6 of 4 tries, " in survey(bags, load_contract(EXAMPLE)).table()


def test_episodes_of_which_a_command_is_too_old_are_left_out_and_its_topic_is_named(tmp_path: Path) -> None:
    bag = Run(3).write(tmp_path / "bag")  # the gripper was commanded once, 2 s before the first episode
    report = survey([bag], load_contract(contract_file(tmp_path / "contract.yaml", actions__1__max_age_ms=5000)))
    assert len(report.episodes) == 1
    assert "left out: 2 stretches without a command of actions.1" in report.table()


def test_a_success_whose_end_lies_in_a_gap_is_no_success_and_counted(tmp_path: Path) -> None:
    messages = [each for each in stream(24) if each[1] != FRONT or each[0] < BEGIN_NS + 1900 * MS]
    (episode,) = one_topic(tmp_path, messages)
    assert not episode.success.any() and episode.truncated
    report = survey([tmp_path / "bag"], load_contract(tmp_path / "contract.yaml"))
    assert "left out: 1 stretches with a success at the end" in report.table()


def test_what_comes_before_the_first_command_and_after_the_last_is_no_part_of_an_episode(tmp_path: Path) -> None:
    (episode,) = one_topic(tmp_path, stream(12, until=5), max_age_ms=110)
    assert episode.images[:, 0, 0, 0].tolist() == list(range(7)) and episode.success[-1]
    report = survey([tmp_path / "bag"], load_contract(tmp_path / "contract.yaml"))
    assert "left out: 5 steps before the first command or after the last" in report.table()


def test_episodes_lie_between_silences_of_the_commands(tmp_path: Path) -> None:
    bag = Run(3).write(tmp_path / "bag")
    contract = contract_file(tmp_path / "contract.yaml", episodes__split={"gap_s": 1.0})
    episodes = imported([bag], contract, tmp_path / "out")
    assert [episode.num_steps for episode in episodes] == [20, 20, 20]
    assert [bool(episode.success[-1]) for episode in episodes] == [True, False, True]


def test_labels_of_a_file_and_instructions_of_a_topic_count_for_their_episodes(tmp_path: Path) -> None:
    def said(messages: list[Message]) -> list[Message]:
        begins = [time_ns for time_ns, topic, one in messages if topic == "/episode" and one.data]
        return messages + [(time_ns - MS, "/say", message("std_msgs/msg/String", data=f"cup {number}"))
                           for number, time_ns in enumerate(begins)]

    bag = Run(2, change=said).write(tmp_path / "bag")
    (tmp_path / "labels.csv").write_text("bag,start_s,end_s,success\nbag,0,4,0\nbag,5,9,1\nother,,,1\n")
    contract = contract_file(tmp_path / "contract.yaml", episodes__success={"file": "labels.csv"},
                             episodes__instruction={"topic": "/say"})
    episodes = imported([bag], contract, tmp_path / "out")
    assert [(one.instruction, bool(one.success[-1])) for one in episodes] == [("cup 0", False), ("cup 1", True)]


def test_a_reward_is_recorded_and_says_where_success_begins(tmp_path: Path) -> None:
    pays = [(BEGIN_NS + step * 100 * MS, "/reward", message("std_msgs/msg/Float64", data=0.25 * step))
            for step in range(6)]
    rule = {"topic": "/reward", "type": "std_msgs/msg/Float64", "above": 0.6}
    (episode,) = one_topic(tmp_path, stream(6) + pays, episodes__success=rule)
    assert episode.success.tolist() == [False, False, False, True, True, True]
    np.testing.assert_allclose(episode.rewards, [0.25, 0.5, 0.75, 1.0, 1.25])


def with_success(values: list[float], kind: str, done: float) -> Callable[[list[Message]], list[Message]]:
    """Run's messages, with success said from each episode's start on every 100 ms, in place of the verdict after it."""
    def change(messages: list[Message]) -> list[Message]:
        begins = [time_ns for time_ns, topic, one in messages if topic == "/episode" and one.data]
        return [each for each in messages if each[1] != "/success"] + [
            (begin_ns + tick * 100 * MS, "/success", message(kind, data=type(done)(value)))
            for begin_ns in begins for tick, value in enumerate(values)
        ]

    return change


@pytest.mark.parametrize(("kind", "done"), [("std_msgs/msg/Bool", True), ("std_msgs/msg/Float64", 1.0)])
@pytest.mark.parametrize(("values", "expected"), [
    ([0] * 25 + [1] * 10, [False] * 21),  # put onto the goal while the table is reset
    ([0] * 15 + [1] * 10 + [0] * 10, [False] * 15 + [True] * 6),  # cleared away afterwards
    ([0] * 20 + [1] + [0] * 10, [False] * 20 + [True]),  # reached at the end, and the episode ends because of it
])
def test_what_a_detector_says_while_the_robot_is_reset_is_not_said_of_the_episode(
    tmp_path: Path, values: list[float], expected: list[bool], kind: str, done: float
) -> None:
    rule = {"topic": "/success", "type": kind} | ({"above": 0.5} if kind != "std_msgs/msg/Bool" else {})
    bag = Run(2, change=with_success(values, kind, done)).write(tmp_path / "bag")
    contract = contract_file(tmp_path / "contract.yaml", episodes__success=rule)
    for episode in imported([bag], contract, tmp_path / "out"):
        assert episode.success.tolist() == expected
        if "above" in rule:
            assert (episode.rewards > 0.5).tolist() == expected[1:]


@pytest.mark.parametrize(("said", "expected"), [
    ({0: False, 3: True, 8: False}, [False, False, False, True, True]),  # cleared away while the table is reset
    ({0: False, 8: True}, [False] * 4 + [True]),  # judged by a person, afterwards
    ({0: False, 8: False}, [False] * 5),
])
def test_what_is_said_of_success_seldom_counts_until_the_next_episode_but_takes_back_none(
    tmp_path: Path, said: dict[int, bool], expected: list[bool]
) -> None:
    says = [(BEGIN_NS + (100 * step + 10) * MS - 20 * MS * (step == 0), "/success", flag(value))
            for step, value in said.items()]
    begin = [(BEGIN_NS - 10 * MS, "/episode", flag(True)), (BEGIN_NS + 510 * MS, "/episode", flag(False))]
    moved = [(time_ns - 10 * MS, topic, one) for time_ns, topic, one in says]
    (episode,) = one_topic(tmp_path, stream(8) + begin + moved, episodes__split={"topic": "/episode"},
                           episodes__success={"topic": "/success"})
    assert episode.success.tolist() == expected


def test_labels_may_begin_with_the_mark_that_spreadsheets_write(tmp_path: Path) -> None:
    bag = Run(2).write(tmp_path / "bag")
    (tmp_path / "labels.csv").write_text("\ufeffbag,start_s,end_s,success\nbag,0,4,0\nbag,5,9,1\n", encoding="utf-8")
    contract = contract_file(tmp_path / "contract.yaml", episodes__success={"file": "labels.csv"})
    assert [bool(one.success[-1]) for one in imported([bag], contract, tmp_path / "out")] == [False, True]


def test_where_stamps_lie_in_another_era_the_time_of_reception_or_of_all_stamps_may_count(tmp_path: Path) -> None:
    shifted = [(time_ns + 40 * 10**9, topic, one) for time_ns, topic, one in stream(6)]
    for timeline in ("header", "receive"):
        folder = tmp_path / timeline
        folder.mkdir()
        (episode,) = one_topic(folder, shifted, timeline=timeline)
        assert episode.num_steps == 5


def test_commands_beyond_the_limits_are_counted_and_clipped_where_that_is_asked_for(tmp_path: Path) -> None:
    (episode,) = one_topic(tmp_path, stream(6, commands=lambda step: (0.1 * step, 0.0)), beyond_limits="clip")
    np.testing.assert_allclose(episode.actions[:, 0], [0, 0.8, 1, 1, 1], atol=1e-6)
    with Bag(tmp_path / "out") as bag:
        assert re.search(r"-0.1 to 0.1 m/s +0 to 0.38 +3 \(60.0%\)", bag.custom["wm.import_table"])


POINT = message("geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0)
TURN = message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.6, w=0.8)
POSE = message("geometry_msgs/msg/PoseStamped", header=header(0),
               pose=message("geometry_msgs/msg/Pose", position=POINT, orientation=TURN))
LAYOUT = message("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)


@pytest.mark.parametrize(("one", "select", "expected"), [
    (POSE, ["pose.position.z", "pose.orientation.w"], [3.0, 0.8]),
    (twist(0, 0.1, -0.2), ["twist.linear.y"], [-0.2]),
    (joint_state(0, a=1.0, b=2.0), ["position.b", "position.a"], [2.0, 1.0]),
    (numbers(1.0, 2.0, 3.0), ["2", "0"], [3.0, 1.0]),
    (message("std_msgs/msg/Float32MultiArray", layout=LAYOUT, data=np.array([0.5], np.float32)), ["0"], [0.5]),
    (message("sensor_msgs/msg/Joy", header=header(0), axes=np.ones(2, np.float32), buttons=np.array([0, 1], np.int32)),
     ["axes.1", "buttons.1"], [1.0, 1.0]),
    (flag(True), ["data"], [1.0]),
    (numbers(1.0), ["1"], None),
    (numbers(np.nan), ["0"], None),
])
def test_numbers_are_selected_by_their_dotted_names(one: Any, select: list[str], expected: list[float] | None) -> None:
    assert Selector(one.__msgtype__, select)(one) == (expected if expected is None else pytest.approx(expected))


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("padding", [0, 3])
def test_an_image_of_any_usual_encoding_is_read_as_rgb(encoding: str, padding: int) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    alpha = np.full((4, 6, 1), 9, np.uint8)
    stored = {"rgb8": rgb, "bgr8": rgb[..., ::-1], "rgba8": np.concatenate([rgb, alpha], -1),
              "bgra8": np.concatenate([rgb[..., ::-1], alpha], -1), "mono8": rgb[..., :1]}[encoding]
    expected = np.repeat(rgb[..., :1], 3, -1) if encoding == "mono8" else rgb
    np.testing.assert_array_equal(rgb_of(image(0, stored, encoding, padding)), expected)


@pytest.mark.parametrize("form", ["png", "rgb8; png compressed bgr8", "bgr8; png compressed bgr8",
                                  "rgb8; png compressed rgb8", "bgr8; png compressed rgb8"])
def test_a_compressed_picture_is_read_in_the_order_that_its_format_says(form: str) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    one = compressed(0, rgb[..., ::-1] if form.endswith("compressed rgb8") else rgb, "png")
    one.format = form
    np.testing.assert_array_equal(rgb_of(one), rgb)


def test_a_picture_of_16_bits_is_refused_whatever_its_format_says() -> None:
    depth = compressed(BEGIN_NS, np.full((4, 6), 700, np.uint16), "png")
    with pytest.raises(BagError, match="bgr8' picture holds uint16 values, as depth does, which is not read"):
        rgb_of(depth)


@pytest.mark.parametrize(("crop", "left", "right"), [("centre", 32, 95), ("none", 0, 127), ((0, 64, 96, 64), 64, 127)])
def test_a_crop_keeps_the_part_that_it_names(crop: Any, left: int, right: int) -> None:
    ramp = np.repeat(np.arange(128, dtype=np.uint8)[None, :, None], 96, 0).repeat(3, -1)
    size = (48, 32) if crop != "none" else (48, 64)
    camera = Camera(topic="/c", type="sensor_msgs/msg/Image", size=size, crop=crop)
    made = fitted(ramp, camera)
    assert made.shape == (*size, 3) and abs(int(made[0, 0, 0]) - left) <= 1 and abs(int(made[0, -1, 0]) - right) <= 1


def test_a_damaged_picture_costs_its_episode_and_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def damage(messages: list[Message]) -> list[Message]:
        pictures = [one for _, topic, one in messages if topic == FRONT]
        for one in pictures[-20:-10]:
            one.data = np.zeros(9, np.uint8)
        return messages

    bag = Run(2, change=damage).write(tmp_path / "bag")
    assert main(["import", "rosbag", str(EXAMPLE), str(bag), "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert printed.count(f"left out: episode 2 of bag: {FRONT}: a 'rgb8; jpeg compressed bgr8' picture of 9 bytes") == 1
    assert len(list(read_episodes(tmp_path / "out"))) == 1


def test_joints_that_another_driver_publishes_on_the_same_topic_are_no_samples(tmp_path: Path) -> None:
    grippers = [(now, JOINTS, joint_state(now, finger=1.0)) for now in range(BEGIN_NS, BEGIN_NS + 600 * MS, 50 * MS)]
    (episode,) = one_topic(tmp_path, stream(6) + grippers)
    np.testing.assert_array_equal(episode.states[:, 0], [0, 1, 2, 3, 4, 5])
