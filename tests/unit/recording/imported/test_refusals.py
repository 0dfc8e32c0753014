"""What a contract, or a bag that does not fit it, is refused for: value and remedy, before anything is written."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_robot import (
    BEGIN_NS,
    EXAMPLE,
    FRONT,
    JOINTS,
    MS,
    POSE,
    TWIST,
    WRIST,
    Message,
    Run,
    contract_file,
    image,
    joint_state,
    message,
    seen,
    write,
)
from mcap.writer import Writer
from rosbags.rosbag2 import StoragePlugin

from wm_nodes.apps.cli import main
from wm_nodes.config.load import ConfigError
from wm_nodes.recording import BagError
from wm_nodes.recording.imported import load_contract, survey

Change = Callable[[list[Message]], list[Message]]

CONTRACTS: list[tuple[dict[str, Any], str]] = [
    ({"decoder": "my.module"}, "decoder: Extra inputs are not permitted"),
    ({"observations__images__front__typo": 1}, "observations.images.front.typo: Extra inputs"),
    ({"format": 2}, "format: Input should be 1"),
    ({"timeline": None}, "timeline: Field required"),
    ({"rate_hz": 0}, "rate_hz: Input should be greater than 0"),
    ({"observations__images__wrist__size": [32, 32]}, "give all of them one size"),
    ({"observations__images__front__topic": "front"}, "observations.images.front.topic: String should match"),
    ({"observations__state__0__names": ["a"]}, "/joint_states selects 2 values, but has {'names': 1}"),
    ({"observations__state__1__names": ["position.j1"]}, "several state values are called position.j1"),
    ({"observations__state__1__names": ["gripper_target"]}, "called gripper_target, but 'target' means commanded"),
    ({"probes__0__names": ["x", "x"]}, "several probe values are called x"),
    ({"actions__0__low": [0.2, 0.2]}, "must be below high"),
    ({"actions__0__high": [0.2]}, "selects 2 values, but has {'high': 1}"),
    ({"actions__0__relative_to": "state"}, "relative to the state, which has no twist.linear.x"),
    ({"task": "reach"}, "task 'reach' is a known one, whose success is told from values of its own"),
    ({"episodes__split": {"per": "bag", "gap_s": 1.0}}, "give one of topic: /NAME, per: bag, gap_s: SECONDS"),
    ({"episodes__success": {"topic": "/s", "file": "l.csv"}}, "give one of topic: /NAME and file: LABELS.csv"),
    ({"episodes__success": {"topic": "/s", "above": 1.0}}, "give it with std_msgs/msg/Float64"),
]


@pytest.mark.parametrize(("changes", "words"), CONTRACTS, ids=[words[:40] for _, words in CONTRACTS])
def test_a_contract_that_says_no_sense_is_refused_by_what_is_wrong(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigError) as refused:
        load_contract(contract_file(tmp_path / "contract.yaml", **changes))
    assert words in str(refused.value) and "contract.yaml" in str(refused.value)


def without(topic: str) -> Change:
    return lambda messages: [each for each in messages if each[1] != topic]


def pictures(encoding: str, picture: Any) -> Change:
    return lambda messages: [
        (time_ns, topic, image(time_ns, picture, encoding) if topic == WRIST else one)
        for time_ns, topic, one in messages
    ]


def mosaic(messages: list[Message]) -> list[Message]:
    for _, topic, one in messages:
        if topic == FRONT:
            one.format = "bayer_rggb8; jpeg compressed "
    return messages


def growing(messages: list[Message]) -> list[Message]:
    half = messages[len(messages) // 2][0]
    return [(time_ns, topic, image(time_ns, seen(0, 0, 64 + 32 * (time_ns > half), 96)) if topic == WRIST else one)
            for time_ns, topic, one in messages]


def stamped(topic: str, change: Callable[[int], int]) -> Change:
    def restamp(messages: list[Message]) -> list[Message]:
        for _, name, one in messages:
            if name == topic:
                time_ns = change(one.header.stamp.sec * 10**9 + one.header.stamp.nanosec)
                one.header.stamp.sec, one.header.stamp.nanosec = divmod(time_ns, 10**9)
        return messages

    return restamp


def behind(by_ms: int) -> Change:
    """Everything is received so much later, and more of the camera."""
    return lambda messages: [
        (time_ns + (by_ms - 5 + 20 * (topic == FRONT)) * MS, topic, one) for time_ns, topic, one in messages
    ]


def slow(topic: str, keep: int) -> Change:
    def thin(messages: list[Message]) -> list[Message]:
        kept = [each for each in messages if each[1] == topic][::keep]
        return [each for each in messages if each[1] != topic] + kept

    return thin


def plans(messages: list[Message]) -> list[Message]:
    duration = message("builtin_interfaces/msg/Duration", sec=0, nanosec=0)
    point = message("trajectory_msgs/msg/JointTrajectoryPoint", positions=np.zeros(1), velocities=np.zeros(0),
                    accelerations=np.zeros(0), effort=np.zeros(0), time_from_start=duration)
    return [(time_ns, topic, message("trajectory_msgs/msg/JointTrajectory", header=one.header, joint_names=["j1"],
                                     points=[point, point]) if topic == TWIST else one)
            for time_ns, topic, one in messages]


PLAN = {"topic": TWIST, "type": "trajectory_msgs/msg/JointTrajectory", "select": ["position.j1"], "unit": "rad",
        "low": [-1], "high": [1], "resample": "last"}
COLOURS = np.zeros((64, 64, 3), np.uint8)
BAGS: dict[str, tuple[Change | None, dict[str, Any], str]] = {
    "missing topic": (without(WRIST), {}, "images.wrist: no message on /wrist/image_raw; topics of "
                      "sensor_msgs/msg/Image: none"),
    "missing probe": (without(POSE), {}, "probes.0: no message on /cup/pose; topics of "
                      "geometry_msgs/msg/PoseStamped: none"),
    "misspelt topic": (None, {"observations__state__0__topic": "/joint_state"},
                       "state.0: no message on /joint_state; topics of sensor_msgs/msg/JointState: /joint_states"),
    "wrong type": (None, {"actions__0__type": "geometry_msgs/msg/Twist"},
                   "/servo/delta_twist_cmds is of geometry_msgs/msg/TwistStamped, not geometry_msgs/msg/Twist"),
    "slow camera": (slow(FRONT, 4), {"max_age_ms": 500}, "images.front: /front/image_raw/compressed comes with 5 Hz, "
                    "less than rate_hz 10: pictures would repeat; lower rate_hz"),
    "slow state": (slow(JOINTS, 20), {}, "comes with 2.5 Hz, and max_age_ms 150 asks for 6.67; raise its max_age_ms"),
    "small picture": (pictures("rgb8", COLOURS[:32, :32]), {}, "keep 32 x 32 px of 32 x 32, less than size [64, 64]"),
    "changing size": (growing, {}, "has pictures of [(64, 96), (96, 96)] px; import bags of one size"),
    "crop": (None, {"observations__images__wrist__crop": [0, 10, 64, 64]},
             "have 64 x 64 px, and crop [0, 10, 64, 64] leaves them"),
    "depth": (pictures("16UC1", np.zeros((64, 64), np.uint16)), {}, "encoding '16UC1' is depth, which is not read"),
    "encoding": (pictures("yuv422", COLOURS), {}, "encoding 'yuv422' is not read; publish one of rgb8, bgr8"),
    "mosaic": (mosaic, {}, "encoding 'bayer_rggb8; jpeg compressed ' is not read; publish one of rgb8, bgr8"),
    "no such joint": (None, {"observations__state__0__select": ["position.j1", "position.j9"]},
                      "no usable message with position.j1, position.j9"),
    "no velocities": (None, {"observations__state__0__select": ["velocity.j1", "velocity.j2"]},
                      "no usable message with velocity.j1"),
    "no such field": (None, {"actions__0__select": ["twist.linear.x", "twist.linear.w"]},
                      "has no 'twist.linear.w'; at 'w' there is x, y, z"),
    "no number": (None, {"actions__0__select": ["twist.linear.x", "twist.linear"]},
                  "is no number; select one field of it"),
    "form of joints": (None, {"observations__state__0__select": ["j1", "j2"]}, "has no 'j1'; select position.JOINT"),
    "a plan": (plans, {"actions__0": PLAN}, "of 2 points is a plan, not a command of one step"),
    "no stamps": (stamped(JOINTS, lambda now: 0), {}, "/joint_states has header stamps of 0; set its timeline"),
    "stamps set back": (stamped(JOINTS, lambda now: now - 3 * 10**9 * (now % 10**10 > 5 * 10**9)), {},
                        "has stamps that fall by 1.1 s; set its timeline to receive"),
    "clocks apart": (stamped(FRONT, lambda now: now - 900 * MS), {}, "lie 905 ms apart, and max_clock_offset_ms is "
                     "500; set timeline to receive, or synchronise"),
    "recorder behind": (behind(400), {}, "actions.1, split, success count from their reception, which is 400 ms after "
                        "the stamps of images.wrist, more than half a step of rate_hz, 50 ms; set timeline: receive"),
    "a clock that was set": (stamped(JOINTS, lambda now: now - BEGIN_NS * (now < BEGIN_NS + 2000 * MS) + 1),
                             {"episodes__split": {"per": "bag"}}, "lasts 472222 h: a clock was set while"),
    "header of none": (None, {"observations__state__1__timeline": "header"},
                       "std_msgs/msg/Float64MultiArray has no header"),
    "beyond": (None, {"actions__0__low": [-0.05, -0.1]}, "commands leave the limits: twist.linear.x from -0.06"),
    "no success": (without("/success"), {}, "success: no message on /success in any bag; correct the topic"),
    "too short": (None, {"episodes__min_steps": 50}, "no episode in "),
    "no labels": (None, {"episodes__success": {"file": "nothing.csv"}}, "nothing.csv cannot be read"),
}


@pytest.mark.parametrize("case", BAGS)
def test_a_bag_that_does_not_fit_the_contract_is_refused_with_the_remedy_and_nothing_is_written(
    tmp_path: Path, case: str, capsys: pytest.CaptureFixture[str]
) -> None:
    change, changes, words = BAGS[case]
    bag = Run(2, **({"change": change} if change else {})).write(tmp_path / "bag")
    contract = contract_file(tmp_path / "contract.yaml", **changes)
    assert main(["import", "rosbag", str(contract), str(bag), "--out", str(tmp_path / "out")]) == 2
    refused = capsys.readouterr().err.splitlines()[-1]
    assert refused.startswith("error: ") and words in refused, refused
    assert not [*tmp_path.glob("out*")]


@pytest.mark.parametrize(("by_ms", "changes"), [
    (40, {}), (400, {"max_clock_offset_ms": 450}), (400, {"timeline": "receive"}),
    (400, {"rate_hz": 1, "max_age_ms": 2000}),
])
def test_clocks_may_lie_half_a_step_apart_or_as_the_contract_says(
    tmp_path: Path, by_ms: int, changes: dict[str, Any]
) -> None:
    bag = Run(1, seconds=6, change=behind(by_ms)).write(tmp_path / "bag")
    assert survey([bag], load_contract(contract_file(tmp_path / "contract.yaml", **changes))).episodes


def test_an_episode_without_a_label_is_named_by_its_bag_and_time(tmp_path: Path) -> None:
    bag = Run(2).write(tmp_path / "bag")
    (tmp_path / "labels.csv").write_text("bag,start_s,end_s,success\nbag,0,4,1\n")
    contract = contract_file(tmp_path / "contract.yaml", episodes__success={"file": "labels.csv"})
    with pytest.raises(BagError, match=r"has no row for bag at 7\.0 s, the middle of an episode; add one: bag,start_s"):
        survey([bag], load_contract(contract))


@pytest.mark.parametrize("rows", ["bag,0,4,1\nbag,3,9,0\n", "bag,0,4,1\nbag,0,4,1\n", "bag,,,0\nbag,5,9,1\n"])
def test_rows_of_labels_that_overlap_are_refused(tmp_path: Path, rows: str) -> None:
    bag = Run(2).write(tmp_path / "bag")
    (tmp_path / "labels.csv").write_text(f"bag,start_s,end_s,success\nother,,,1\n{rows}")
    contract = contract_file(tmp_path / "contract.yaml", episodes__success={"file": "labels.csv"})
    with pytest.raises(BagError, match=r"labels\.csv have two rows of bag that overlap, 0 to (4|inf) s and \d to \d s"):
        survey([bag], load_contract(contract))


def test_bags_of_one_name_are_refused_where_labels_name_them(tmp_path: Path) -> None:
    (tmp_path / "labels.csv").write_text("bag,start_s,end_s,success\nbag_0,,,1\n")
    for labels, names in (("labels.csv", ("monday/bag_0", "tuesday/bag_0")), (None, ("monday/bag_1", "tuesday/bag_1"))):
        for name in names:
            (tmp_path / name).parent.mkdir(exist_ok=True)
        bags = [Run(1).write(tmp_path / name) for name in names]
        rule = {"episodes__success": {"file": labels}} if labels else {}
        contract = load_contract(contract_file(tmp_path / "contract.yaml", **rule))
        if labels:
            with pytest.raises(BagError, match=r"monday/bag_0 and \S+tuesday/bag_0 have one name, and .*; rename one"):
                survey(bags, contract)
        else:
            assert len(survey(bags, contract).episodes) == 2


def test_a_bag_and_its_own_file_are_refused(tmp_path: Path) -> None:
    bag = Run(1).write(tmp_path / "bag")
    (file,) = bag.glob("*.mcap")
    with pytest.raises(BagError, match=rf"{file} is a file of {bag}, and its episodes would be there twice"):
        survey([file, bag], load_contract(EXAMPLE))
    assert len(survey([bag, bag / ".." / "bag"], load_contract(EXAMPLE)).planned) == 1


def test_a_bag_of_ros_1_is_refused_with_the_command_that_converts_it(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r"run `rosbags-convert --src \S+run\.bag --dst \S+run`"):
        survey([tmp_path / "run.bag"], load_contract(EXAMPLE))


def test_an_mcap_of_ros_1_messages_is_refused_with_the_command_that_converts_the_original(tmp_path: Path) -> None:
    with (tmp_path / "run.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros1")
        schema = writer.register_schema("sensor_msgs/JointState", "ros1msg", b"")
        writer.add_message(writer.register_channel(JOINTS, "ros1", schema), BEGIN_NS, b"", BEGIN_NS)
        writer.finish()
    with pytest.raises(BagError, match=r"state\.0: /joint_states holds ros1 messages.*run `rosbags-convert --src BAG"):
        survey([tmp_path / "run.mcap"], load_contract(EXAMPLE))


@pytest.mark.parametrize("timeline", ["header", "receive"])
@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_during_which_a_clock_was_set_back_is_refused(
    tmp_path: Path, plugin: StoragePlugin, timeline: str
) -> None:
    messages = sorted(Run(2).messages(), key=lambda each: each[0])
    half_ns = messages[len(messages) // 2][0]
    late = {id(one) for time_ns, _, one in messages if time_ns > half_ns}
    for one in (one for _, _, one in messages if id(one) in late and hasattr(one, "header")):
        one.header.stamp.sec -= 3
    fallen = [(time_ns - 3000 * MS * (id(one) in late), topic, one) for time_ns, topic, one in messages]
    write(tmp_path / "bag", fallen, plugin, as_listed=True)
    contract = load_contract(contract_file(tmp_path / "contract.yaml", timeline=timeline))
    with pytest.raises(BagError, match=r"images\.front: a clock was set back by 1\.1 s while \S+ was recorded"):
        survey([tmp_path / "bag"], contract)


@pytest.mark.parametrize(("head", "words"), [
    ("bag;start_s;end_s;success\nbag;;;1\n", r"its first line is 'bag;start_s;end_s;success'; it is a CSV"),
    ("", r"its first line is ''; it is a CSV with the columns bag"),
])
def test_a_file_of_labels_without_the_columns_is_refused_with_what_it_has(
    tmp_path: Path, head: str, words: str
) -> None:
    (tmp_path / "labels.csv").write_text(head)
    contract = contract_file(tmp_path / "contract.yaml", episodes__success={"file": "labels.csv"})
    with pytest.raises(BagError, match=words):
        survey([Run(1).write(tmp_path / "bag")], load_contract(contract))


def test_a_folder_that_exists_is_refused_before_a_bag_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["import", "rosbag", str(EXAMPLE), str(tmp_path / "nothing"), "--out", str(tmp_path)]) == 2
    assert "exists already; choose another name" in capsys.readouterr().err


def test_every_problem_of_a_bag_is_named_at_once(tmp_path: Path) -> None:
    bag = Run(2).write(tmp_path / "bag")
    contract = contract_file(tmp_path / "contract.yaml", observations__state__0__topic="/joints",
                             observations__images__front__topic="/front")
    with pytest.raises(BagError, match=r"images\.front: no message on /front.*state\.0: no message on /joints"):
        survey([bag], load_contract(contract))


def test_without_a_folder_the_table_is_all_that_is_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = Run(1).write(tmp_path / "bag")
    assert main(["import", "rosbag", str(EXAMPLE), str(bag)]) == 0
    assert "bags: 1; episodes: 1, 1 of them end in success; steps: 20" in capsys.readouterr().out
    assert [*tmp_path.iterdir()] == [bag]


def test_a_joint_that_no_message_has_is_refused_with_those_that_there_are(tmp_path: Path) -> None:
    def renamed(messages: list[Message]) -> list[Message]:
        return [(time_ns, topic, joint_state(time_ns, a=0.0, b=1.0) if topic == JOINTS else one)
                for time_ns, topic, one in messages]

    bag = Run(1, change=renamed).write(tmp_path / "bag")
    with pytest.raises(BagError, match=r"no usable message .*\(105 others, and the last one names a, b\)"):
        survey([bag], load_contract(EXAMPLE))
