"""The two clients of an environment, without DDS."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("wm_msgs.msg", reason="wm_msgs is not built")

from rclpy.task import Future
from recording_samples import make_spec

from wm_msgs.msg import ErrorCode
from wm_msgs.srv import GetEnvSpec
from wm_nodes.core.errors import WireError
from wm_nodes.ros import convert
from wm_nodes.ros.clients import EnvironmentClient, LocalEnvironmentClient, RosEnvironmentClient
from wm_nodes.ros.wire import PeerLost, ResetCommand, StepCommand

SHORT_S = 0.05


class RefusingClient:
    """A service client that is answered at once: the spec, and to everything else a refusal."""

    srv_name = "/wm/env/step"

    def __init__(self, kind: Any, code: int) -> None:
        self._kind, self._code = kind, code

    def service_is_ready(self) -> bool:
        return True

    def call_async(self, request: Any) -> Future:
        answer, future = self._kind.Response(error_code=self._code, message="refused"), Future()
        if self._kind is GetEnvSpec:
            answer = GetEnvSpec.Response(spec=convert.spec_msg(make_spec(), 0))
        future.set_result(answer)
        return future


def remote(code: int) -> EnvironmentClient:
    node = SimpleNamespace(
        create_client=lambda kind, name: RefusingClient(kind, code), own=lambda *work: None, destroy_client=None,
        get_namespace=lambda: "/wm", peers=SimpleNamespace(is_lost=lambda name: False),
    )
    return RosEnvironmentClient(node, timeout_s=SHORT_S)  # type: ignore[arg-type]


def local(code: int) -> EnvironmentClient:
    def refuse(command: Any) -> None:
        raise WireError(code, "refused")

    served = SimpleNamespace(step=refuse, reset=refuse, spec=make_spec())
    return LocalEnvironmentClient(lambda: served, SHORT_S)


@pytest.mark.parametrize("client_of", [remote, local])
@pytest.mark.parametrize(
    ("code", "error"),
    [
        (ErrorCode.NOT_ACTIVE, PeerLost), (ErrorCode.BUSY, PeerLost), (ErrorCode.SPEC_MISMATCH, PeerLost),
        (ErrorCode.ESTOP, WireError),
    ],
)
def test_an_environment_that_may_come_back_is_lost_and_another_refusal_is_an_error(
    client_of: Callable[[int], EnvironmentClient], code: int, error: type[Exception]
) -> None:
    client = client_of(code)
    client.handshake(1.0, lambda: None)
    command = StepCommand(session=1, step_id=1, spec_hash="", actions=np.zeros(2, np.float32))
    with pytest.raises(error, match="refused"):
        client.step(command, lambda: None)
    with pytest.raises(error, match="refused"):
        client.reset(ResetCommand(), lambda: None)
