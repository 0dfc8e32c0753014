"""What the reward agent adds to both reward evaluators: verdict topic, rubric service, diagnostics,
and an action that judges clips in a folder.
"""

import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from wm_msgs.action import JudgeClips
from wm_msgs.msg import ClipVerdict, ErrorCode
from wm_msgs.srv import SetRubric
from wm_nodes.config.judge import JudgeConfig
from wm_nodes.config.load import ConfigError
from wm_nodes.config.schema import RunConfig
from wm_nodes.config.video import VideoRlConfig
from wm_nodes.core.errors import WireError
from wm_nodes.core.named_files import FileKind, shown
from wm_nodes.judge.agent.contract import pause_reason
from wm_nodes.judge.agent.types import GATED, Status
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.clip_files import AT_ONCE, list_sha256, read_job, read_list
from wm_nodes.judge.service import POLL_S, READS, ClipJob, JudgeService
from wm_nodes.nodes.judge.verdict_message import verdict_msg
from wm_nodes.ros import convert, diagnostics
from wm_nodes.ros.actions import WorkerAction
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param, named_files
from wm_nodes.ros.worker import Work

PARAMS = (
    Param("audit_dir", "", "Folder of the reward agent's audit log, relative to run_dir; empty: none is written",
          read_only=True),
)


class JudgeServices:
    """Owns the node's JudgeService until cleanup. The world model of the node's `model_dir` gives the evidence beside a
    server's answers. Rounds are judged one after the other; the node calls stop when it is deactivated.

    Args:
        config: of the run; its seed and device are taken.
        busy: whether the node has clips of its own judged: the rubric is not changed meanwhile.

    Raises:
        ValueError, ConfigError: as JudgeService.
    """

    def __init__(
        self, node: ManagedNode, settings: JudgeConfig, config: RunConfig | VideoRlConfig, busy: Callable[[], bool]
    ) -> None:
        self._node, self._busy = node, busy
        audit, models = str(node.param("audit_dir")), str(node.param("model_dir"))
        self.judge = JudgeService(
            settings, seed=config.seed, reads=node.run_dir / READS, audit=node.run_dir / audit if audit else None,
            model_dir=Path(models) if models else None, device=config.device,
        )
        node.own(self.judge.close)
        self._files = named_files(node, *([settings.rubric] if settings.rubric.endswith((".yaml", ".yml")) else []))
        for card in self.judge.cards:
            node.get_logger().info(card)
        self._verdicts = node.publish_on("reward/verdict")
        node.serve(SetRubric, "reward/set_rubric", self._on_set_rubric, counted="refused_rubrics")
        self._turn = threading.Lock()
        self._action = WorkerAction(node, JudgeClips, "reward/judge_clips", self._judge_folder)
        self.judge.refresh_health()

    def stop(self, reason: str) -> None:
        """End the judging of a folder."""
        self._action.stop(reason)

    def judge_round(
        self, work: Work, jobs: Sequence[ClipJob], progress: Any, *, of: int, sha256: str, deadline: float | None,
        iteration: int = 0, first: int = 0,
    ) -> tuple[list[Verdict], list[ClipVerdict]]:
        """Judge clips for an action's goal; every verdict is published as it is given.

        Args:
            progress: feedback of EvaluateClips or JudgeClips, brought forward and sent with every verdict.
            of: clips of the goal. first: index of the first of `jobs` among them. sha256: of the file that has them.
            deadline: on the time.monotonic clock, s; clips without a verdict by then have no reward. None: no limit.

        Raises:
            Cancelled: the goal is to end.
        """
        messages = dict[int, ClipVerdict]()

        def done(clip: int, verdict: Verdict) -> None:
            message = self.publish(verdict, clip=first + clip, iteration=iteration, buffer_sha256=sha256)
            messages[clip] = message
            progress.clips_done += 1
            progress.clips_invalid += not verdict.valid
            passed = zip(progress.stages_passed, message.stage_passed, strict=True)
            progress.stages_passed = [count + more for count, more in passed]
            progress.calls += verdict.cost.calls
            progress.prompt_tokens += verdict.cost.prompt_tokens
            progress.progress = progress.clips_done / of
            work.feedback(progress)

        with self._my_turn(work):
            verdicts = self.judge.judge(
                jobs, check=work.check, done=done, round_number=iteration,
                within_s=None if deadline is None else max(0.0, deadline - time.monotonic()),
            )
        return verdicts, [messages[clip] for clip in range(len(jobs))]

    def publish(
        self, verdict: Verdict, *, clip: int, iteration: int, buffer_sha256: str = "", stamp_ns: int | None = None
    ) -> ClipVerdict:
        """Publish a verdict and note it in the diagnostics; return its message. See ClipVerdict for the arguments.

        stamp_ns: None: now.
        """
        message = verdict_msg(verdict)
        message.header = convert.header(self._node.get_clock().now().nanoseconds if stamp_ns is None else stamp_ns, "")
        message.clip, message.iteration, message.buffer_sha256 = clip, iteration, buffer_sha256
        self._verdicts.publish(message)
        self._node.diagnostics.latency("verdict", verdict.cost.wall_s)
        if verdict.status is Status.ERROR:
            self._node.get_logger().error(f"{verdict.clip_id}: {verdict.reason}", throttle_duration_sec=1.0)
        return message

    def pause(self, verdicts: Sequence[Verdict]) -> str:
        """Why training must pause after a round's verdicts, told to the diagnostics too; "" where it may go on."""
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
        }
        for name, value in values.items():
            board.gauge(name, value)
        for name, number in health.details.items():
            board.gauge(f"judge {name}", number)
        open_ = int(health.details.get("open_breakers", 0))
        board.gauge("breaker", f"open: {open_}" if open_ else "closed")
        if health.available:
            board.clear_condition("judge")
        else:
            board.set_condition("judge", diagnostics.WARN, f"judge {judge.judge_id}: {health.reason}")

    def _on_set_rubric(self, request: SetRubric.Request, response: SetRubric.Response) -> SetRubric.Response:
        if request.pack and (self._busy() or self._action.busy):
            raise WireError(ErrorCode.BUSY, "clips are being judged by the present rubric; set another one later")
        if request.pack:
            self._set_rubric(request.pack)
        response.pack, response.version = self.judge.pack, self.judge.rubric.version
        return response

    def _set_rubric(self, pack: str) -> None:
        """Raises WireError(OUT_OF_RANGE) where the pack is refused; the rubric is then the one before."""
        before = self.judge.rubric.version
        try:
            self.judge.set_rubric(pack, self._files)
        except (ConfigError, ValueError, OSError) as error:
            text = f"rubric {shown(pack)} refused: {' '.join(str(error).split())}"
            raise WireError(ErrorCode.OUT_OF_RANGE, text) from None
        self._node.get_logger().info(f"rubric {before} -> {self.judge.rubric.version}")

    # Clips in a folder.

    @contextmanager
    def _my_turn(self, work: Work) -> Iterator[None]:
        while not self._turn.acquire(timeout=POLL_S):
            work.check()
        try:
            yield
        finally:
            self._turn.release()

    def _read(self, path: Path, kind: FileKind) -> bytes:
        return self._files.read(str(path), kind)

    def _judge_folder(self, work: Work, result: JudgeClips.Result) -> None:
        goal: JudgeClips.Goal = work.request
        progress = JudgeClips.Feedback(stages_passed=[0] * len(GATED))
        verdicts, messages = list[Verdict](), list[ClipVerdict]()
        at_once = max(AT_ONCE, self.judge.settings.concurrency)
        try:
            deadline = deadline_of(goal.deadline_s)
            folder = self._files.path(goal.folder)
            lines, sha256 = read_list(folder, self._read), list_sha256(folder, goal.sha256, self._read)
            for first in range(0, len(lines), at_once):
                jobs = [read_job(folder, line, self._read) for line in lines[first : first + at_once]]
                judged, round_messages = self.judge_round(
                    work, jobs, progress, of=len(lines), sha256=sha256, deadline=deadline, first=first
                )
                verdicts += judged
                messages += round_messages
        finally:
            result.verdicts, result.pause_reason = messages, pause_reason(verdicts)


def deadline_of(seconds: float) -> float | None:
    """When a goal's clips must be judged, on the time.monotonic clock; None: no limit, which is 0 s.

    Raises:
        ValueError: no number of seconds.
    """
    if not 0 <= seconds < math.inf:
        raise ValueError(f"deadline_s must be 0 (no limit) or a number of seconds, got {seconds:g}")
    return time.monotonic() + seconds if seconds else None
