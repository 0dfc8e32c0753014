"""What ROS tools need of an environment's cameras: pictures with calibration, and frames, over DDS."""

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from graph.harness import Graph, Probe, wait_until
from graph.test_environment import Client
from graph.toy import SIDE_PX, TwoCameras
from sensor_msgs.msg import CameraInfo, Image

from wm_nodes.nodes.environment.camera_topics import cameras_of
from wm_nodes.recording import Bag
from wm_nodes.recording.messages import images_of, time_ns
from wm_nodes.ros.wire import Reply

pytestmark = pytest.mark.graph
N, SHOWN = 4, 2
TOP, HAND = TwoCameras(1, 0).cameras


@pytest.fixture
def client(graph: Graph, probe: Probe) -> Client:
    graph.start_environment("toy:make_environment_with_cameras", num_envs=N, view_env=SHOWN, view_period_s=0.05)
    return Client(probe)


def move(client: Client, before: Reply) -> Reply:
    actions = np.random.default_rng(before.step_id).uniform(-1, 1, (N, 3))
    return client.step(client.command(before.step_id + 1, actions))


def pose_of(message: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    """(4, 4) of a TransformStamped."""
    t, q = message.transform.translation, message.transform.rotation
    x, y, z, w = q.x, q.y, q.z, q.w
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.vstack([np.column_stack([rotation, [t.x, t.y, t.z]]), [0, 0, 0, 1]])


@pytest.mark.slow
def test_a_picture_and_its_calibration_have_one_stamp_and_one_frame(client: Client) -> None:
    infos: list[CameraInfo] = client.probe.listen("env/camera/hand/camera_info")
    first = wait_until("the latched calibration, before any observation", lambda: infos)[0]
    assert (first.width, first.height, first.distortion_model) == (SIDE_PX, SIDE_PX, "plumb_bob")
    np.testing.assert_array_equal(first.k, HAND.K.reshape(-1))
    np.testing.assert_array_equal(first.p.reshape(3, 4), np.column_stack([HAND.K, np.zeros(3)]))
    np.testing.assert_array_equal(first.r.reshape(3, 3), np.eye(3))
    assert not any(first.d) and len(first.d) == 5
    images = client.probe.listen("env/image")
    pictures: list[Image] = client.probe.listen("env/camera/hand/image_raw")
    reply = client.reset()

    def seen() -> list[Image]:
        """Pictures whose mosaic has come too."""
        nonlocal reply
        reply = move(client, reply)
        whole.update({time_ns(image.header.stamp): image for image in images})
        return [picture for picture in pictures if time_ns(picture.header.stamp) in whole]

    whole = dict[int, Image]()
    wait_until("pictures", lambda: len(seen()) > 3)
    found = seen()
    time.sleep(0.2)  # for the calibration of the last one
    calibrated = {time_ns(info.header.stamp) for info in infos}
    for picture in found:
        assert time_ns(picture.header.stamp) in calibrated
        assert picture.header.frame_id == first.header.frame_id == "wm_camera_hand_optical"
        assert (picture.width, picture.height, picture.step) == (SIDE_PX, SIDE_PX, 3 * SIDE_PX)
        mosaic = images_of(whole[time_ns(picture.header.stamp)], client.spec)
        pixels = np.frombuffer(picture.data, np.uint8).reshape(SIDE_PX, SIDE_PX, 3)
        np.testing.assert_array_equal(pixels, mosaic[SHOWN, :, SIDE_PX:])
    assert client.probe.node.count_subscribers("/wm/env/camera/top/image_raw") == 0


def test_a_still_camera_has_a_latched_frame_and_a_moving_one_that_of_each_observation(client: Client) -> None:
    reply = move(client, client.reset())
    still = client.probe.listen("env/camera/top/transform")
    moving = client.probe.listen("env/camera/hand/transform")
    message = wait_until("the latched transform", lambda: still)[0]
    assert (message.header.frame_id, message.child_frame_id) == ("wm_base", "wm_camera_top_optical")
    np.testing.assert_allclose(pose_of(message), TOP.pose_in(), atol=1e-9)
    wait_until("matching", lambda: client.probe.node.count_publishers("/wm/env/camera/hand/transform"))
    replies = {reply.stamp_ns: reply}

    def moved() -> bool:
        nonlocal reply
        reply = move(client, reply)
        replies[reply.stamp_ns] = reply
        return len(moving) > 3

    wait_until("frames of several observations", moved)
    assert len(still) == 1
    for message in moving:
        tool = replies[time_ns(message.header.stamp)].states[SHOWN]
        np.testing.assert_allclose(pose_of(message)[:3, 3], np.add(tool, (0, -0.1, 0.1)), atol=1e-6)
        np.testing.assert_allclose(pose_of(message)[:3, 2], np.array([0, 1, -1]) / 2**0.5, atol=1e-6)


@pytest.mark.slow
def test_a_recorder_takes_the_topics_of_a_camera_when_it_is_told_to(client: Client, graph: Graph) -> None:
    names = ["env/camera/top/camera_info", "env/camera/top/transform", "env/camera/top/image_raw"]
    recorder = graph.start("recorder", topics=json.dumps(["env/spec", *names]))
    reply = client.reset()

    def recorded() -> bool:
        nonlocal reply
        reply = move(client, reply)
        return int(client.probe.value("/wm/recorder", "messages") or 0) > 8

    wait_until("messages", recorded)
    recorder.terminate()
    assert recorder.wait(20) == 0
    with Bag(graph.folder / "bags" / "bag_000") as bag:
        counts = [bag.count(f"/wm/{name}") for name in names]
    assert counts[0] > 3 and counts[1] == 1 and counts[2] > 2


def test_an_environment_that_says_nothing_of_its_cameras_has_no_such_topics_and_the_log_says_what_to_give(
    graph: Graph, probe: Probe
) -> None:
    graph.start_environment(num_envs=N)
    images = probe.listen("env/image")
    client = Client(probe)
    wait_until("matching", lambda: client.probe.node.count_publishers("/wm/env/image"))
    client.reset()
    assert wait_until("an image", lambda: images)[0].header.frame_id == "wm_base"
    assert not [name for name, _ in probe.node.get_topic_names_and_types() if "/env/camera/" in name]
    assert graph.log("/wm/environment").count("the attribute `cameras` (wm_nodes/core/cameras.py)") == 1


def test_a_camera_whose_pose_cannot_be_told_is_counted_and_stops_no_step(graph: Graph, probe: Probe) -> None:
    graph.start_environment("toy:make_environment_with_a_lost_camera", num_envs=N)
    client = Client(probe)
    heard = probe.listen("env/camera/hand/transform")
    reply = client.reset()

    def counted() -> bool:
        nonlocal reply
        reply = move(client, reply)
        return bool(probe.value("/wm/environment", "camera_pose_errors"))

    wait_until("the count", counted)
    assert not heard
    wait_until("the reason", lambda: "TimeoutError: no joint states" in probe.diagnostics["/wm/environment"].message)


def test_cameras_that_do_not_fit_the_spec_are_refused() -> None:
    environment = TwoCameras(1, 0)
    environment.spec = replace(environment.spec, cameras=("top", "wrist"))
    with pytest.raises(ValueError, match=r"camera 'hand' is none of \['top', 'wrist'\]"):
        cameras_of(environment)
    environment = TwoCameras(1, 0)
    environment.spec = replace(environment.spec, width=4 * SIDE_PX)
    with pytest.raises(ValueError, match=r"camera top says \(16, 16\) px \(W, H\), its picture has \(32, 16\)"):
        cameras_of(environment)


HASH = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
"""As `ros2 topic info --verbose /tf` says it with ROS 2 Jazzy from apt."""
LISTENER = """
import json, sys, rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage
rclpy.init()
node, heard = rclpy.create_node("listener"), {}
def note(name, message):
    frames = [[t.header.frame_id, t.child_frame_id, t.transform.translation.x] for t in message.transforms]
    heard.setdefault(name, frames)
latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # as tf2_ros.TransformListener
node.create_subscription(TFMessage, "/tf", lambda m: note("/tf", m), 100)
node.create_subscription(TFMessage, "/tf_static", lambda m: note("/tf_static", m), latched)
while len(heard) < 2:
    rclpy.spin_once(node, timeout_sec=0.1)
offered = node.get_publishers_info_by_topic("/tf_static")[0]
print(json.dumps({**heard, "type": [offered.topic_type, str(offered.topic_type_hash)]}))
"""


def test_tf_has_the_frames_in_the_type_that_ros_2_itself_has_and_that_of_the_mosaic(
    graph: Graph, probe: Probe
) -> None:
    graph.start_environment("toy:make_environment_with_cameras", num_envs=N, mode="asynchronous")
    done = subprocess.run(
        [sys.executable, "-c", LISTENER], env=graph.environment(), capture_output=True, text=True, timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    heard = json.loads(done.stdout)
    assert heard["/tf_static"] == [["wm_base", "wm_camera_top_optical", pytest.approx(0.6)]]
    assert [frames[:2] for frames in heard["/tf"]] == [["wm_base", "wm_camera_hand_optical"]]
    images = probe.listen("env/image")
    assert wait_until("an image", lambda: images)[0].header.frame_id == heard["/tf_static"][0][1]
    assert heard["type"] == ["tf2_msgs/msg/TFMessage", HASH]


@pytest.mark.slow
def test_without_tf2_msgs_a_camera_has_its_own_topics_alone(
    domain: int, probe: Probe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tf2_msgs.py").write_text("raise ImportError('not installed')\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]))
    graph = Graph(domain, tmp_path / "run", forks=False)
    graph.start_environment("toy:make_environment_with_cameras", num_envs=N)
    try:
        heard = probe.listen("env/camera/top/transform")
        wait_until("the frame", lambda: heard, timeout_s=60)
        Client(probe).reset()
        names = [name for name, _ in probe.node.get_topic_names_and_types()]
        assert "/wm/env/camera/hand/transform" in names and not {"/tf", "/tf_static"}.intersection(names)
    finally:
        assert graph.stop() == {"/wm/environment": 0}
