"""Requests that claim to hold more than there is memory for: the node stays below its limit, lives, and answers."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from graph.harness import MATCH_S, Graph, Probe
from graph.raw_publisher import RawPublisher
from graph.test_environment import Client
from message_generator import Lie, encode, fields_of

from wm_msgs.srv import ResetBatch, StepBatch
from wm_nodes.ros import calls

pytestmark = pytest.mark.graph
LIMIT_GIB = 1.0
SHARED_GIB = 0.3
"""Libraries and shared memory, which the limit does not count; 0.1 was seen."""
LENGTHS = (2**28, 2**31, 2**32 - 1)
"""What one list of a request claims to have, in numbers of 1 to 8 bytes."""


def lies(kind: type[Any]) -> list[bytes]:
    """Requests of less than 100 bytes."""
    made = []
    for place, field in enumerate(fields_of(kind())):
        for length in LENGTHS if isinstance(field.value, list) else ():
            fields = fields_of(kind())
            fields[place].value = Lie(length, [])
            made.append(encode(fields))
    return made


def most_gib(pid: int) -> float:
    """The most memory that a process had at any time."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 2**20


@pytest.mark.slow
@pytest.mark.parametrize("executor", ["events", "single", "multi"])
def test_a_flood_of_requests_that_claim_gigabytes_leaves_the_node_below_its_limit_and_answering(
    graph: Graph, probe: Probe, executor: str
) -> None:
    node = graph.start_environment(memory_limit_gib=LIMIT_GIB, executor=executor)
    client = Client(probe)
    before = client.reset()
    assert client.step(client.command(before.step_id + 1)).step_id == before.step_id + 1
    for kind, name in ((StepBatch, "env/step"), (ResetBatch, "env/reset")):
        requests = RawPublisher(probe.node, kind.Request, f"rq/wm/{name}Request")
        time.sleep(MATCH_S)
        for data in 2 * lies(kind.Request):
            requests.publish(data)
        requests.destroy()
    request = calls.step_request(client.command(before.step_id + 2, np.zeros((4, 3))))
    assert probe.call(StepBatch, "env/step", request, 60.0).step_id == before.step_id + 2
    request = calls.step_request(client.command(before.step_id + 3, np.zeros((4, 3))))
    assert probe.call(StepBatch, "env/step", request).step_id == before.step_id + 3
    assert node.poll() is None and most_gib(node.pid) < LIMIT_GIB + SHARED_GIB
    assert "dropped what asked for more memory" in graph.log("/wm/environment")
