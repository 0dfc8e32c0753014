"""What other ROS tools look at: the compressed image, one environment alone, service events, over DDS."""

import cv2
import numpy as np
import pytest
from graph.harness import Graph, Probe, wait_until
from graph.test_environment import Client
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from sensor_msgs.msg import Image

from wm_msgs.srv import GetEnvSpec
from wm_nodes.recording.messages import images_of
from wm_nodes.ros.lifecycle import SERVICE_EVENTS
from wm_nodes.ros.qos import VIEW

pytestmark = pytest.mark.graph
N = 4


def test_the_compressed_image_is_the_mosaic_and_is_made_only_while_someone_looks(graph: Graph, probe: Probe) -> None:
    graph.start_environment(num_envs=N, compressed_period_s=0.0, compressed_quality=95, view_env=2)
    client, images = Client(probe), probe.listen("env/image")
    views: list[Image] = []
    probe.node.create_subscription(Image, "env/image/view", views.append, VIEW)
    wait_until("matching", lambda: probe.node.count_publishers("/wm/env/image/view"))
    assert probe.node.count_subscribers("/wm/env/image/compressed") == 0
    client.reset()
    wait_until("the image", lambda: images)
    compressed = probe.listen("env/image/compressed")

    def looked() -> bool:
        client.reset()
        return bool(compressed and views)

    wait_until("the JPEG and the view", looked)
    first = compressed[0]
    assert first.format == "rgb8; jpeg compressed bgr8"
    mosaic = wait_until("its image", lambda: [m for m in images if m.header.stamp == first.header.stamp])[0]
    decoded = cv2.cvtColor(cv2.imdecode(np.frombuffer(first.data, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    pixels = np.frombuffer(mosaic.data, np.uint8).reshape(mosaic.height, mosaic.width, 3)
    assert decoded.shape == pixels.shape
    assert np.abs(decoded.astype(int) - pixels).mean() < 12
    alone = views[-1]
    whole = next(m for m in images if m.header.stamp == alone.header.stamp)
    np.testing.assert_array_equal(
        np.frombuffer(alone.data, np.uint8).reshape(alone.height, alone.width, 3),
        images_of(whole, client.spec)[2],
    )


def test_service_events_are_published_while_the_parameter_says_so(graph: Graph, probe: Probe) -> None:
    graph.start_environment(num_envs=N, service_introspection="contents")
    client = Client(probe)
    events: list[GetEnvSpec.Event] = []
    probe.node.create_subscription(GetEnvSpec.Event, "env/get_spec/_service_event", events.append, SERVICE_EVENTS)
    wait_until("matching", lambda: probe.node.count_publishers("/wm/env/get_spec/_service_event"))

    def asked_and_answered() -> bool:
        probe.call(GetEnvSpec, "env/get_spec", GetEnvSpec.Request())
        return any(event.request for event in events) and any(event.response for event in events)

    wait_until("an event with the request and one with the answer", asked_and_answered)
    answered = next(event for event in events if event.response)
    assert answered.response[0].spec.spec_hash == client.spec.spec_hash
    off = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="off")
    change = SetParameters.Request(parameters=[Parameter(name="service_introspection", value=off)])
    assert probe.call(SetParameters, "environment/set_parameters", change).results[0].successful
    wait_until("silence", lambda: not probe.node.count_publishers("/wm/env/get_spec/_service_event"))
