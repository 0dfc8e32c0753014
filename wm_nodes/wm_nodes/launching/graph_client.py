"""Steer a running graph from a plain program: send goals, show feedback, fetch results."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np
from rclpy.action import ActionClient
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from wm_msgs.action import Evaluate, Rollout, Train, TrainVideo
from wm_msgs.msg import RunState
from wm_nodes.core.errors import RunError
from wm_nodes.core.types import BoolArray
from wm_nodes.ros.goals import run_goal, same_process
from wm_nodes.ros.liveliness import HEARTBEAT_S, PeerWatch, activities_here
from wm_nodes.ros.params import PEER_TIMEOUT_S
from wm_nodes.ros.qos import topic
from wm_nodes.ros.spin import init, spinning

ACCEPT_S = 30.0


class GoalFailed(RunError):
    """A goal ended otherwise than finished; the text is the node's own."""


class GraphClient:
    """Client of one graph's `rollout`, `train`, `evaluate` and `video/train` actions; use as a context manager.

    Args:
        namespace: of the graph, e.g. "wm".
        alive: called while waiting; raises when the graph is gone.
    """

    def __init__(self, namespace: str = "wm", *, alive: Callable[[], None] = lambda: None) -> None:
        self._alive = alive
        init()
        self._node = Node("operator", namespace=namespace)
        self._peers = PeerWatch("", PEER_TIMEOUT_S, activities_here())
        row = topic("run/state")
        self._node.create_subscription(row.type, row.name, self._note_peer, row.reader_qos)
        self._node.create_timer(HEARTBEAT_S, self._peers.check, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._rollout = ActionClient(self._node, Rollout, "rollout")
        self._train = ActionClient(self._node, Train, "train")
        self._evaluate = ActionClient(self._node, Evaluate, "evaluate")
        self._train_video = ActionClient(self._node, TrainVideo, "video/train")
        self._spinning = ExitStack()
        self._spinning.enter_context(spinning(self._node))

    def rollout(self, steps: int, *, seed: int = 0, deterministic: bool = False) -> Rollout.Result:
        """Let the policy act, by default with its noise, in so many lock-steps after a reset.

        Raises:
            GoalFailed: the rollout ended early. PeerLost: no policy node, or it ended meanwhile.
        """
        goal = Rollout.Goal(steps=steps, seed=seed, reset=True, deterministic=deterministic)
        return self._run(self._rollout, "policy", goal, lambda message: None)

    def evaluate(
        self, *, episodes: int, seed: int, deterministic: bool, label: str, policy_uri: str = "",
        on_progress: Callable[[int, float], None] = lambda done, rate: None,
    ) -> BoolArray:
        """Play `episodes` with the newest weights (or those of policy_uri); return their success, (E,) in seed order.

        Raises:
            GoalFailed: the evaluation ended early. PeerLost: no evaluation node, or it ended meanwhile.
        """
        goal = Evaluate.Goal(
            episodes=episodes, seed=seed, deterministic=deterministic, behaviour=label, policy_uri=policy_uri
        )
        result = self._run(
            self._evaluate, "evaluation", goal, lambda m: on_progress(m.feedback.episodes_done, m.feedback.success_rate)
        )
        return np.asarray(result.success, bool)

    def train(self, updates: int, on_progress: Callable[[Any], None] = lambda feedback: None) -> Train.Result:
        """Make policy updates, fewer where the exploit meter stops them (message says why); on_progress gets
        Train.Feedback messages.

        Raises:
            GoalFailed: the training ended early. PeerLost: no learner, or it ended meanwhile.
        """
        goal, ends = Train.Goal(updates=updates), (Train.Result.FINISHED, Train.Result.LIMIT)
        return self._run(self._train, "learner", goal, lambda message: on_progress(message.feedback), ends)

    def train_video(self, iterations: int, on_progress: Callable[[Any], None] = lambda feedback: None) -> None:
        """Post-train the video model on so many buffers; on_progress gets TrainVideo.Feedback.

        Raises:
            GoalFailed: the training ended early. PeerLost: no learner, or it ended meanwhile.
        """
        goal = TrainVideo.Goal(iterations=iterations)
        self._run(self._train_video, "learner", goal, lambda message: on_progress(message.feedback))

    def _run(
        self, client: ActionClient, server: str, goal: Any, on_feedback: Callable[[Any], None],
        ends: Sequence[int] = (0,),
    ) -> Any:
        """server: the node. ends: the reasons that are no failure; 0 is FINISHED in every action."""
        alive = same_process(self._peers, f"{self._node.get_namespace().rstrip('/')}/{server}")
        result = run_goal(client, goal, accept_s=ACCEPT_S, check=self._alive, alive=alive, on_feedback=on_feedback)
        if result.termination_reason not in ends:
            raise GoalFailed(result.message or f"the goal ended with reason {result.termination_reason}")
        return result

    def _note_peer(self, message: RunState) -> None:
        if message.state in (RunState.FINISHED, RunState.FAILED):
            self._peers.left(message.node)
        else:
            self._peers.heard(message.node, identity=message.detail)

    def __enter__(self) -> "GraphClient":
        return self

    def __exit__(self, *error: object) -> None:
        self._spinning.close()
