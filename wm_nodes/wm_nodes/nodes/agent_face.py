"""The reward agent's face in the graph, the same in both reward evaluators: verdict topic, rubric service, diagnostics.

Specification: section 2.9.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from yaml import YAMLError

from wm_msgs.msg import ClipVerdict, ErrorCode
from wm_msgs.srv import SetRubric
from wm_nodes.config.load import ConfigError
from wm_nodes.config.schema import JudgeConfig
from wm_nodes.learning.clip_evidence import ClipEvidence
from wm_nodes.learning.clip_judging import READS, ClipJudge
from wm_nodes.reward.agent import Status, Verdict, pause_reason
from wm_nodes.ros import convert, diagnostics
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param
from wm_nodes.ros.verdicts import verdict_msg
from wm_nodes.ros.wire import WireError

PARAMS = (
    Param("audit_dir", "", "Folder of the reward agent's audit log, relative to run_dir; empty: none is written",
          read_only=True),
)  # fmt: skip


class AgentFace:
    """Owns the node's ClipJudge until cleanup. The world model of the node's `model_dir` measures the evidence that the
    rubric has bands of.

    Args:
        busy: whether clips are being judged: the rubric is not changed meanwhile.

    Raises:
        ValueError, ConfigError: as ClipJudge.
    """

    def __init__(self, node: ManagedNode, settings: JudgeConfig, seed: int, busy: Callable[[], bool]) -> None:
        self._node, self._busy = node, busy
        audit, models = str(node.param("audit_dir")), str(node.param("model_dir"))
        self.judge = ClipJudge(
            settings, seed=seed, reads=node.run_dir / READS, audit=node.run_dir / audit if audit else None,
            evidence=ClipEvidence(Path(models) if models else None),
        )  # fmt: skip
        node.own(self.judge.close)
        for card in self.judge.cards:
            node.get_logger().info(card)
        self._verdicts = node.publish_on("reward/verdict")
        node.serve(SetRubric, "reward/set_rubric", self._on_set_rubric)
        self.judge.refresh_health()

    def publish(
        self, verdict: Verdict, *, clip: int, iteration: int, buffer_sha256: str = ""
    ) -> ClipVerdict:
        """Publish a verdict and note it in the diagnostics; return its message. See ClipVerdict for the arguments."""
        message = verdict_msg(verdict)
        message.header = convert.header(self._node.get_clock().now().nanoseconds, "")
        message.clip, message.iteration, message.buffer_sha256 = clip, iteration, buffer_sha256
        self._verdicts.publish(message)
        self._node.diagnostics.latency("verdict", verdict.cost.wall_s)
        if verdict.status is Status.ERROR:
            self._node.get_logger().error(f"{verdict.clip_id}: {verdict.reason}", throttle_duration_sec=1.0)
        return message

    def pause(self, verdicts: Sequence[Verdict]) -> str:
        """Why training must pause after a round's verdicts, told to the diagnostics too; "" where it may go on. A round
        that another judge than the first had to judge is a warning there.
        """
        if fallen_back := self.judge.fallen_back:
            self._node.get_logger().warning(fallen_back)
            self._node.diagnostics.set_condition("judge_fallback", diagnostics.WARN, fallen_back)
        else:
            self._node.diagnostics.clear_condition("judge_fallback")
        reason = pause_reason(verdicts)
        if reason:
            self._node.get_logger().error(reason)
            self._node.diagnostics.set_condition("invalid_verdicts", diagnostics.ERROR, reason)
        else:
            self._node.diagnostics.clear_condition("invalid_verdicts")
        return reason

    def update_diagnostics(self) -> None:
        """Set gauges, and the condition `judge` while no server answers; call it once a second."""
        judge, board = self.judge, self._node.diagnostics
        judge.refresh_health()
        tally, health = judge.tally, judge.health
        values = {
            "judge": judge.judge_id, "rubric": judge.rubric.version, "verdicts": tally.verdicts,
            "abstained": tally.by_status.get(Status.ABSTAIN, 0), "errors": tally.by_status.get(Status.ERROR, 0),
            "invalid_rate": tally.invalid_rate, "cached_ratio": tally.cached_ratio, "calls": tally.cost.calls,
            "prompt_tokens": tally.cost.prompt_tokens, "images": tally.cost.images, "retries": tally.cost.retries,
        }  # fmt: skip
        for name, value in values.items():
            board.gauge(name, value)
        for name, number in health.details.items():
            board.gauge(f"judge {name}", number)
        open_ = int(health.details.get("open_breakers", 0))
        board.gauge("breaker", f"open: {open_}" if open_ else "closed")
        if health.available:
            board.clear_condition("judge")
        else:
            board.set_condition("judge", diagnostics.WARN, f"judge {judge.judge_ids[0]}: {health.reason}")

    def _on_set_rubric(self, request: SetRubric.Request, response: SetRubric.Response) -> SetRubric.Response:
        try:
            if request.pack and self._busy():
                raise WireError(ErrorCode.BUSY, "clips are being judged by the present rubric; set another one later")
            if request.pack:
                self._set_rubric(request.pack, self._node.run_dir)
        except WireError as error:
            return convert.fill_error(response, error)
        response.pack, response.version = self.judge.pack, self.judge.rubric.version
        return response

    def _set_rubric(self, pack: str, base: Path) -> None:
        """Raises WireError(OUT_OF_RANGE) where the pack is refused; the rubric is then the one before."""
        before = self.judge.rubric.version
        try:
            self.judge.set_rubric(pack, base)
        except (ConfigError, ValueError, OSError, YAMLError) as error:
            raise WireError(ErrorCode.OUT_OF_RANGE, f"rubric {pack!r} refused: {error}") from None
        self._node.get_logger().info(f"rubric {before} -> {self.judge.rubric.version}")
