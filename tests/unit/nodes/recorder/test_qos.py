"""QoS of a bag's topics, as the player offers them."""

import pytest

pytest.importorskip("wm_msgs.msg", reason="wm_msgs is not built")

from rclpy.qos import QoSCompatibility, qos_check_compatible

from wm_nodes.nodes.recorder.qos import offered_qos, recorded_qos
from wm_nodes.recording.topics import ALL_TOPICS, VIDEO_TOPICS
from wm_nodes.ros.qos import topic


@pytest.mark.parametrize("name", sorted({row.name for row in (*ALL_TOPICS, *VIDEO_TOPICS)}))
def test_a_replayed_topic_reaches_the_nodes_that_read_the_live_one(name: str) -> None:
    row = topic(name)
    compatible, reason = qos_check_compatible(offered_qos([recorded_qos(row.qos)]), row.reader_qos)
    assert compatible == QoSCompatibility.OK, reason
