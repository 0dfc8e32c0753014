"""The exploit meter of a learner node: the model in the learner's own process, the simulator over DDS."""

from pathlib import Path

from wm_nodes.config.schema import RunConfig
from wm_nodes.core.errors import WireError
from wm_nodes.core.types import Environment
from wm_nodes.nodes.environment.remote_environment import RemoteEnvironment
from wm_nodes.nodes.factories import existing
from wm_nodes.nodes.learner.report import LearnerReport
from wm_nodes.policy_rl.training_run import PolicyTraining
from wm_nodes.policy_rl.validation.exploit_meter import ExploitMeter, ExploitReading, make_exploit_meter
from wm_nodes.ros.clients import Check, RosEnvironmentClient
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.wire import PeerLost

SIMULATOR, NAME = "sim", "exploit_meter"
"""Namespace of the simulator, as the evaluation node's; what its episodes there and the readings are called."""
STEP_TIMEOUT_S, HANDSHAKE_S = 20.0, 20.0


class LearnerMeter:
    """Takes the readings that are due. What stands in the way of one is said in one line; training goes on without.

    Args:
        node: its parameters model_dir, starts_file and video_model_dir name what is trained in.
        report: gets the numbers of each reading.
    """

    def __init__(
        self, node: ManagedNode, config: RunConfig, training: PolicyTraining, report: LearnerReport
    ) -> None:
        self._node, self._training, self._report = node, training, report
        self._check: Check = lambda: None
        self._meter: ExploitMeter | None = None
        if config.exploit_meter.every == 0:
            return
        self._client = RosEnvironmentClient(node, SIMULATOR, STEP_TIMEOUT_S)
        try:
            self._meter = self._make(config)
        except (ValueError, OSError) as error:
            self._say(f"the exploit meter is off: {error}")

    def check(self, check: Check) -> str:
        """As ExploitMeter.check, of the training's policy. check: raises what ends the goal."""
        if self._meter is None:
            return ""
        self._check = check
        try:
            return self._meter.check(self._training.policy, self._training.updates)
        except (PeerLost, WireError, ValueError, FloatingPointError) as error:
            self._say(f"no reading of the exploit meter after update {self._training.updates}: {error}")
            return ""

    def _make(self, config: RunConfig) -> ExploitMeter | None:
        named = {name: str(self._node.param(name)) for name in ("model_dir", "starts_file", "video_model_dir")}
        model, starts = (existing(named[name], name) for name in ("model_dir", "starts_file"))
        video = Path(named["video_model_dir"]) if named["video_model_dir"] else None
        return make_exploit_meter(config, model, starts, self._simulator, self._read, video_model_dir=video)

    def _simulator(self) -> Environment:
        """Met anew for every reading: it may have been started again."""
        return RemoteEnvironment(
            self._client, self._check, timeout_s=HANDSHAKE_S, behaviour=NAME, policy_version=self._training.version
        )

    def _read(self, updates: int, reading: ExploitReading) -> None:
        self._report.measured(NAME, self._training.progress, reading.metrics())

    def _say(self, text: str) -> None:
        self._node.diagnostics.count("missing_readings", text=text)
        self._node.get_logger().warning(text)
