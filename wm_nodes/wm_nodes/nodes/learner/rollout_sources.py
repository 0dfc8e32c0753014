"""Where the learner's rollouts come from: a policy that acts now, a bag's file, or a bag that a player replays."""

import threading
import time
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Protocol

from rclpy.action import ActionClient

from wm_msgs.action import Replay
from wm_msgs.action import Rollout as RolloutAction
from wm_msgs.msg import ErrorCode
from wm_nodes.core.errors import WireError
from wm_nodes.core.lockstep import DroppedTransitions
from wm_nodes.core.named_files import NamedFiles
from wm_nodes.core.specs import EnvironmentSpec
from wm_nodes.core.types import Rollout
from wm_nodes.nodes.factories import existing
from wm_nodes.nodes.learner.rollout_assembler import RolloutAssembler
from wm_nodes.policy_rl.rollouts import TensorRollout
from wm_nodes.policy_rl.training_run import Progress
from wm_nodes.recording import BagReport, read_rollouts, topics
from wm_nodes.ros.clients import Check
from wm_nodes.ros.goals import run_goal, same_process
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.wire import PeerLost
from wm_nodes.ros.worker import Work

RETRY_S = 0.5
MAX_GAP_RETRIES = 2
TRAINING_PEERS = ("environment", "policy", "reward_evaluator")
REPLAYED = tuple(topic.name for topic in (topics.SPEC, topics.IMAGES, topics.TRANSITION, topics.REWARD))
ARRIVAL_S = 2.0
"""After the player's end: how long nothing may arrive before the stream counts as over. An update in the worker thread
can keep the callbacks waiting."""


class RolloutSource(Protocol):
    """One goal's rollouts, in order."""

    @property
    def left_out(self) -> list[str]:
        """What was passed over and why, for the message of a goal that could not make all its updates."""
        ...

    def next(self) -> tuple[Rollout | TensorRollout, DroppedTransitions] | None:
        """The next rollout of the version that is trained now; None when there will be no more.

        Raises:
            PeerLost, WireError, ValueError, OSError: as the learner reports them. Cancelled: the work must stop.
        """
        ...

    def close(self) -> None: ...


class _IncompleteRollout(PeerLost):
    """Images or rewards of a rollout that was made did not arrive."""


class LiveRollouts:
    """Asks the policy node for rollouts and joins what the graph publishes about them. check: as ReplayedRollouts's."""

    def __init__(
        self, node: ManagedNode, work: Work, check: Check, progress: Progress, assembler: RolloutAssembler,
        client: ActionClient, *, num_steps: int, seed: int,
    ) -> None:
        self._node, self._work, self._check, self._progress = node, work, check, progress
        self._assembler, self._client = assembler, client
        self._num_steps, self._seed = num_steps, seed
        self.left_out: list[str] = []

    def next(self) -> tuple[Rollout, DroppedTransitions] | None:
        """The rollout of the version that is trained now, repeated until it is made: the same seed gives it again.

        A lost node may take recovery_timeout_s to come back, from the first loss on; a rollout that was made ends the
        wait, and so does an attempt in which steps were made and that took longer. One of which something did not
        arrive is made MAX_GAP_RETRIES times more, and then once more and taken with its gaps.
        """
        node, began_s = self._node, time.monotonic()
        recovery_s = float(node.param("recovery_timeout_s"))
        gaps = repeats = 0
        lost_s: float | None = None
        while True:
            attempt_s = time.monotonic()
            try:
                rollout = self._attempt(accept_gaps=gaps > MAX_GAP_RETRIES)
                if repeats:
                    node.get_logger().info(f"the rollout is complete after {time.monotonic() - began_s:.1f} s")
                return rollout
            except _IncompleteRollout as error:
                gaps, lost_s, text = gaps + 1, None, str(error)
            except PeerLost as error:
                now_s, text = time.monotonic(), str(error)
                worked = self._assembler.num_collected > 0 and now_s - attempt_s > recovery_s
                lost_s = now_s if lost_s is None or worked else lost_s
                if now_s - lost_s > recovery_s:
                    raise PeerLost(f"{text}; nothing came back for {recovery_s:g} s") from None
            node.diagnostics.count("repeated_rollouts", text=f"rollout repeated: {text}")
            if not repeats:
                node.get_logger().warning(f"rollout repeated until it is complete: {text}")
            repeats += 1
            self._work.sleep(RETRY_S)

    def close(self) -> None:
        self._assembler.end()

    def _attempt(self, *, accept_gaps: bool) -> tuple[Rollout, DroppedTransitions]:
        node, version = self._node, self._progress.version
        goal = RolloutAction.Goal(
            policy_version=version, steps=self._num_steps, seed=self._seed, reset=True, behaviour="policy"
        )
        policy = f"{node.get_namespace().rstrip('/')}/policy"
        same_policy = same_process(node.peers, policy)

        def alive() -> None:
            self._check_peers()
            same_policy()

        alive()
        self._assembler.begin()
        result: RolloutAction.Result = run_goal(self._client, goal, accept_s=5.0, check=self._check, alive=alive)
        if result.termination_reason == RolloutAction.Result.FAILED:
            raise WireError(ErrorCode.INTERNAL, f"the policy node failed: {result.message}")
        if result.termination_reason != RolloutAction.Result.FINISHED:
            raise PeerLost(f"{policy} cut the rollout short: {result.message}")
        span = (result.env_session, result.first_step_id, result.last_step_id)
        deadline = time.monotonic() + float(node.param("join_timeout_s"))
        while missing := self._assembler.missing(*span):
            self._check()
            if time.monotonic() > deadline:
                node.diagnostics.count("incomplete_steps", len(missing), text=f"{len(missing)} lock-steps incomplete")
                if accept_gaps:
                    break
                raise _IncompleteRollout(
                    f"images or rewards of {len(missing)} lock-steps did not arrive; is every node active?"
                )
            self._assembler.wait(0.1)
        return self._assembler.take(*span, version)

    def _check_peers(self) -> None:
        namespace = self._node.get_namespace().rstrip("/")
        lost = [name for name in self._node.peers.lost if name.removeprefix(f"{namespace}/") in TRAINING_PEERS]
        if lost:
            raise PeerLost(f"{', '.join(lost)} is silent")


class BagRollouts:
    """Reads rollouts straight from bags. expected: refuse a bag of another camera, size, action or state."""

    def __init__(
        self, paths: Sequence[Path], progress: Progress, *, num_steps: int, expected: EnvironmentSpec | None
    ) -> None:
        self._progress, self._report = progress, BagReport()
        self._rollouts = self._read(paths, num_steps, expected)

    @property
    def left_out(self) -> list[str]:
        return self._report.incomplete

    def next(self) -> tuple[Rollout, DroppedTransitions] | None:
        stale = 0
        for rollout in self._rollouts:
            if rollout.policy_version == self._progress.version:
                return rollout, DroppedTransitions(stale=stale)
            stale += int(rollout.valid_TN.sum())
        self._progress.dropped_stale += stale
        return None

    def close(self) -> None:
        self._rollouts.close()

    def _read(self, paths: Sequence[Path], num_steps: int, expected: EnvironmentSpec | None) -> Generator[Rollout]:
        for path in paths:
            yield from read_rollouts(path, num_steps=num_steps, expected=expected, report=self._report)


class ReplayedRollouts:
    """Trains from the stream of a player: has it play `uris` one after the other or, without any, takes what is played.

    The player is held back by credit on env/transition while the learner works.

    Args:
        check: called while it waits; raises what ends the goal.
    """

    def __init__(
        self, node: ManagedNode, check: Check, progress: Progress, assembler: RolloutAssembler, client: ActionClient,
        uris: Sequence[str], *, num_steps: int,
    ) -> None:
        self._node, self._check, self._progress, self._assembler = node, check, progress, assembler
        self.left_out: list[str] = []
        self._error: Exception | None = None
        self._thread: threading.Thread | None = None
        self._closed = threading.Event()
        assembler.begin(num_steps)
        if uris:
            self._thread = threading.Thread(target=self._play, args=(client, list(uris)), name="replay")
            self._thread.start()

    def next(self) -> tuple[Rollout, DroppedTransitions] | None:
        stale = gap = 0
        while True:
            self._check()
            if self._error is not None:
                raise self._error
            taken = self._assembler.take_replayed(float(self._node.param("join_timeout_s")))
            if taken is None:
                if self._over():
                    self._progress.dropped_stale += stale
                    self._progress.dropped_gap += gap
                    return None
                self._assembler.wait(0.1)
                continue
            version, rollout, dropped = taken
            if rollout is None:
                self.left_out.append(f"a rollout of policy_version {version} was incomplete")
                gap += dropped.gap
            elif version != self._progress.version:
                stale += int(rollout.valid_TN.sum())
                gap += dropped.gap
            else:
                return rollout, DroppedTransitions(dropped.invalid, gap + dropped.gap, stale + dropped.stale)

    def close(self) -> None:
        self._closed.set()
        self._assembler.end()
        if self._thread is not None:
            self._thread.join(5.0)

    def _over(self) -> bool:
        """Whether the stream has ended; its last, unfinished rollout is then given up."""
        silent_s = time.monotonic() - self._assembler.heard_s
        if self._thread is None:
            over = silent_s > float(self._node.param("recovery_timeout_s"))
        else:
            over = not self._thread.is_alive() and self._error is None and silent_s > ARRIVAL_S
        if over:
            self._assembler.finish()
        return over and not self._assembler.waiting

    def _play(self, client: ActionClient, uris: list[str]) -> None:
        """In a thread: have the bags played, as fast as `replay_rate` and the credit allow."""

        def check() -> None:
            self._check()
            if self._closed.is_set():
                raise PeerLost("training has ended")

        alive = same_process(self._node.peers, f"{self._node.get_namespace().rstrip('/')}/player")
        try:
            for uri in uris:
                goal = Replay.Goal(
                    bag_uri=uri, rate=float(self._node.param("replay_rate")), publish_clock=True, topics=list(REPLAYED)
                )
                result = run_goal(client, goal, accept_s=10.0, check=check, alive=alive)
                if result.termination_reason != Replay.Result.FINISHED:
                    raise WireError(ErrorCode.IO_ERROR, f"the player ended: {result.message}")
        except Exception as error:  # raised again by next()
            self._error = error


def bag_paths(uris: Sequence[str], files: NamedFiles) -> list[Path]:
    """Absolute paths of bag_uris. Raises ValueError without any, FileNotFoundError for a missing one; FileRefused."""
    if not uris:
        raise ValueError("bag_uris is empty; name at least one recorded bag")
    return [existing(str(files.readable(uri)), "bag_uris") for uri in uris]
