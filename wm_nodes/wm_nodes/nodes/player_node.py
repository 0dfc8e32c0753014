"""player: publishes a bag's messages again, byte for byte, with their QoS and the bag's time on /clock."""

import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.exceptions import NameValidationException
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.validate_full_topic_name import validate_full_topic_name
from rosbags.interfaces import Connection, ConnectionExtRosbag2
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from wm_msgs.action import Replay
from wm_msgs.msg import Credit, ErrorCode
from wm_msgs.srv import PlayNext, Seek, SetRate
from wm_nodes.core.errors import WireError
from wm_nodes.nodes.recorder.qos import message_class, offered_qos
from wm_nodes.recording import Bag, BagError
from wm_nodes.recording.cdr import session_and_seq
from wm_nodes.recording.playback import Playback
from wm_nodes.recording.typestore import other_type
from wm_nodes.ros import diagnostics
from wm_nodes.ros.actions import WorkerAction
from wm_nodes.ros.convert import time_msg
from wm_nodes.ros.flow_control import ProducerCredits
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param, named_files
from wm_nodes.ros.spin import run_node
from wm_nodes.ros.wire import Cancelled
from wm_nodes.ros.worker import Work

FEEDBACK_S = 0.2
CREDITED = "env/transition"
NOT_PLAYED = ("/run/state", "/flow/credit", "/clock", "/diagnostics")
"""Signs of life and of demand: left out unless named, since recorded ones would speak for absent nodes."""

MATCH_S = 1.0
"""Time for subscribers to find fresh publishers before the first message, s."""

RELEASE_S = 2.0
"""How long the executor may hold on to a destroyed publisher, whose topic has its type until then, s."""

LINKS_S = 5.0
"""How long at most the first message waits for nodes of the graph that have not found each other (ros.links), s."""

PARAMS = (
    Param("bag_uri", "", "Bag to play when activated, and by a replay goal without one; relative to run_dir"),
    Param("play_at_start", True, "Play bag_uri when activated", read_only=True),
    Param("start_paused", False, "Begin paused: player/resume or player/play_next go on"),
    Param("rate", 1.0, "Recorded seconds per second", minimum=1e-3, maximum=1e6),
    Param("start_offset", 0.0, "Where to begin", "s", minimum=0.0),
    Param("loop", False, "Begin again at the end"),
    Param("publish_clock", True, "Publish the bag's time on /clock"),
    Param("topics", [""], "Topics to play, relative or absolute; empty: all but signs of life (run/state, flow/credit, "
          "/clock, /diagnostics)"),
)


class PlayerNode(ManagedNode):
    """Action replay; services player/pause, resume, set_rate, seek, play_next."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("player", PARAMS, **node_arguments)
        self._files = named_files(self, str(self.param("bag_uri")))  # as the user gave it: others may set it later
        self._playback: Playback | None = None
        self._thread: threading.Thread | None = None
        self._outlets: dict[str, Publisher] = {}
        self._offered: dict[str, tuple[type[Any], QoSProfile]] = {}  # of the outlets; a next bag may have others
        self._lock = threading.Lock()

    def configure(self) -> None:
        self._clock_publisher = self.publish_unnumbered("/clock")
        self._credits: dict[int, ProducerCredits] = {}
        self.listen("flow/credit", self._on_credit)
        for name, act in (("pause", Playback.pause), ("resume", Playback.resume)):
            self.serve(Trigger, f"player/{name}", partial(self._on_trigger, act))
        serve = partial(self.serve, counted="refused_requests", code=ErrorCode.OUT_OF_RANGE)
        serve(SetRate, "player/set_rate", self._on_set_rate)
        serve(Seek, "player/seek", self._on_seek)
        serve(PlayNext, "player/play_next", self._on_play_next)
        self._action = WorkerAction(self, Replay, "replay", self._replay)

    def activate(self) -> None:
        uri = str(self.param("bag_uri"))
        if not uri or not self.param("play_at_start"):
            return
        request = Replay.Goal(
            bag_uri=uri, rate=float(self.param("rate")), start_offset=float(self.param("start_offset")),
            loop=bool(self.param("loop")), publish_clock=bool(self.param("publish_clock")),
            topics=[name for name in self.param("topics") if name],
        )
        playback = self._open(request)
        self._thread = threading.Thread(target=self._play_alone, args=(playback, request), name="player")
        self._thread.start()

    def deactivate(self, reason: str) -> None:
        self._action.stop(reason)
        if self._playback is not None:
            self._playback.stop()
        if self._thread is not None:
            self._thread.join(5.0)
        self._thread = None

    def cleanup(self) -> None:
        for publisher in self._outlets.values():
            self.destroy_publisher(publisher)
        self._outlets, self._offered = {}, {}

    def update_diagnostics(self) -> None:
        playback = self._playback
        self.diagnostics.gauge("playing", playback is not None)
        if playback is not None:
            self.diagnostics.gauge("position_s", playback.position_s)
            self.diagnostics.gauge("messages", playback.messages)

    # Playing.

    def _open(self, request: Replay.Goal) -> Playback:
        """Raises BagError when the bag cannot be played or another is being played; as NamedFiles.readable."""
        uri = request.bag_uri or str(self.param("bag_uri"))
        if not uri:
            raise BagError("no bag named; set bag_uri in the goal or as a parameter")
        path = self._files.readable(uri)
        namespace = self.get_namespace().rstrip("/")
        names = [name if name.startswith("/") else f"{namespace}/{name}" for name in request.topics]
        with self._lock:
            if self._playback is not None:
                raise BagError("another bag is being played; cancel that goal or wait")
            playback = Playback(
                path, names=self._playable(path, names), rate=request.rate, start_offset_s=request.start_offset,
                loop=request.loop, paused=bool(self.param("start_paused")),
            )
            self._playback = playback
        try:
            for name, connection in playback.topics.items():
                self._make_outlet(name, connection)
        except BaseException:
            self._playback = None
            raise
        self.diagnostics.clear_condition("playing")
        return playback

    def _playable(self, path: Path, names: list[str]) -> list[str]:
        """The named topics, or all of the bag that can be played; those left out are said and counted.

        Raises:
            BagError: a named topic cannot be played, or none can.
        """
        with Bag(path) as bag:
            connections = list(bag.connections)
        problems = {c.topic: problem for c in connections if (problem := _problem(c))}
        if asked := [f"{name}: {problems[name]}" for name in names if name in problems]:
            raise BagError(f"bag {path} cannot be played on {'; '.join(asked)}; name others in the goal's `topics`")
        if names:
            return names
        wanted = {c.topic for c in connections if not c.topic.endswith(NOT_PLAYED)}
        left_out = [f"{name}: {problems[name]}" for name in sorted(wanted & problems.keys())]
        if left_out and wanted <= problems.keys():
            raise BagError(f"bag {path} has no topic that can be played: {'; '.join(left_out)}")
        for text in left_out:
            self.get_logger().warning(f"not played: {text}")
            self.diagnostics.count("left_out_topics", text=f"not played: {text}")
        return sorted(wanted - problems.keys())

    def _make_outlet(self, name: str, connection: Connection) -> None:
        assert isinstance(connection.ext, ConnectionExtRosbag2)
        kind, qos = message_class(connection.msgtype), offered_qos(list(connection.ext.offered_qos_profiles))
        if self._offered.get(name) == (kind, qos):
            return
        if name in self._outlets:
            del self._offered[name]
            self.destroy_publisher(self._outlets.pop(name))
        deadline = time.monotonic() + RELEASE_S
        while name not in self._outlets:
            try:
                self._outlets[name], self._offered[name] = self.create_publisher(kind, name, qos), (kind, qos)
            except RuntimeError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.02)

    def _play(self, playback: Playback, request: Replay.Goal, work: Work | None) -> None:
        last_feedback = 0.0

        def check() -> None:
            nonlocal last_feedback
            if playback.stopped:
                raise Cancelled("deactivated")
            if work is None:
                return
            work.check()
            if time.monotonic() - last_feedback >= FEEDBACK_S:
                last_feedback = time.monotonic()
                work.feedback(Replay.Feedback(position=playback.position_s, messages=playback.messages))

        def publish(name: str, data: bytes) -> None:
            if name.endswith(f"/{CREDITED}"):
                self._wait_for_credit(playback, data, check)
            self._outlets[name].publish(data)

        def tick(time_ns: int) -> None:
            if request.publish_clock:
                self._clock_publisher.publish(Clock(clock=time_msg(time_ns)))

        try:
            self._await_readers(playback, check)
            playback.run(publish, tick, check, self._say, self._credits.clear)  # other numbers were granted before
        finally:
            self._playback = None
        if playback.damaged:
            parts, name = "; ".join(playback.damaged), request.bag_uri or self.param("bag_uri")
            raise BagError(f"bag {name} is damaged: {parts}; all else was played, {playback.messages} messages")

    def _say(self, text: str) -> None:
        self.get_logger().warning(text)
        self.diagnostics.count("playback_warnings", text=text)

    def _await_readers(self, playback: Playback, check: Callable[[], None]) -> None:
        """Wait until the outlets' subscribers have found them; a paused player lets the user wait instead."""
        began = time.monotonic()
        while not playback.paused and (waited_s := time.monotonic() - began) < LINKS_S:
            if waited_s > MATCH_S and not self.links.table.missing():
                return
            check()
            time.sleep(0.02)

    def _play_alone(self, playback: Playback, request: Replay.Goal) -> None:
        try:
            with suppress(Cancelled):
                self._play(playback, request, None)
            self.get_logger().info(f"played {playback.messages} messages")
        except Exception as error:
            trace = "" if isinstance(error, BagError) else f"\n{traceback.format_exc()}"
            self.get_logger().error(f"playing failed: {error}{trace}".rstrip())
            self.diagnostics.set_condition("playing", diagnostics.ERROR, str(error) or type(error).__name__)

    def _replay(self, work: Work, result: Replay.Result) -> None:
        began = time.monotonic()
        playback = self._open(work.request)
        self._play(playback, work.request, work)
        if not self.active:
            raise Cancelled("deactivated")
        result.messages, result.duration = playback.messages, time.monotonic() - began

    def _wait_for_credit(self, playback: Playback, data: bytes, check: Callable[[], None]) -> None:
        """Hold a transition back until every consumer has granted it, as the environment does."""
        session, seq = session_and_seq(data)
        credits = self._credits.setdefault(session, ProducerCredits(CREDITED, session))
        if not credits.blocking_consumers(seq):
            return
        with playback.held_back():
            while credits.blocking_consumers(seq):
                for name in credits.drop_silent(seq):
                    text = f"{name} granted nothing for 5 s and is not waited for"
                    self.diagnostics.count("silent_consumers", text=text)
                check()
                time.sleep(0.002)

    def _on_credit(self, message: Credit) -> None:
        credits = self._credits.get(message.stream_session)
        if credits is not None:
            credits.note(message)

    # Services.

    def _on_trigger(
        self, act: Callable[[Playback], None], request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        playback = self._playback
        if playback is None:
            response.message = "not playing; send a replay goal"
            return response
        act(playback)
        response.success = True
        return response

    def _on_set_rate(self, request: SetRate.Request, response: SetRate.Response) -> SetRate.Response:
        self._playing().set_rate(request.rate)
        return response

    def _on_seek(self, request: Seek.Request, response: Seek.Response) -> Seek.Response:
        self._playing().seek(request.position)
        return response

    def _on_play_next(self, request: PlayNext.Request, response: PlayNext.Response) -> PlayNext.Response:
        response.played = self._playing().play_next(request.num_messages)
        return response

    def _playing(self) -> Playback:
        if self._playback is None:
            raise WireError(ErrorCode.NOT_ACTIVE, "not playing; send a replay goal")
        return self._playback


def _problem(connection: Connection) -> str:
    """Why a recorded topic cannot be played; "" where it can."""
    assert isinstance(connection.ext, ConnectionExtRosbag2)
    if connection.ext.serialization_format != "cdr":
        return f"its messages are {connection.ext.serialization_format or 'of no known format'}, and cdr is published"
    if difference := other_type(connection):
        return f"it was recorded with {difference}"
    try:
        message_class(connection.msgtype)
        validate_full_topic_name(connection.topic)
    except (ValueError, NameValidationException) as error:
        return str(error).replace("\n", " ")
    return ""


def main() -> None:
    sys.exit(run_node(PlayerNode))


if __name__ == "__main__":
    main()
