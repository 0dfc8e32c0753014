"""recorder: writes the graph's topics, byte for byte as received, into a rosbag2 MCAP bag."""

import json
import shutil
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile
from rosbags.serde import SerdeError
from std_srvs.srv import Trigger

from wm_msgs.msg import ErrorCode
from wm_msgs.srv import StartRecording, StopRecording
from wm_nodes.core.errors import WireError
from wm_nodes.core.files import write_atomic
from wm_nodes.nodes.recorder.qos import recorded_qos
from wm_nodes.recording import BagError, RawBagWriter, RecordingError, topics
from wm_nodes.recording import messages as m
from wm_nodes.recording.raw import PARTIAL_SUFFIX
from wm_nodes.ros import convert, diagnostics
from wm_nodes.ros.flow_control import ConsumerCredits
from wm_nodes.ros.lifecycle import ManagedNode
from wm_nodes.ros.params import Param, named_files
from wm_nodes.ros.qos import TOPICS, GraphTopic, row_name
from wm_nodes.ros.sequence_numbers import GapTracker
from wm_nodes.ros.spin import run_node

FLUSH_S = 0.25
QUIET_S = 0.3
"""After a stop, the bag is completed when no message has come for this long."""
MIB = 2**20
SEQUENCED = {topic.name for topic in (*topics.ALL_TOPICS, *topics.VIDEO_TOPICS) if topic.sequenced}
DEFAULT_TOPICS = [topic.name for topic in topics.ALL_TOPICS]

PARAMS = (
    Param("bag_uri", "", "Bag folder, relative to run_dir; empty: the next free run_dir/bags/bag_NNN", read_only=True),
    Param("topics", DEFAULT_TOPICS, "Topics to record, relative to the namespace", read_only=True),
    Param("record_at_start", True, "Begin to record when activated; else wait for recorder/start", read_only=True),
    Param("split_mib", 256, "Start a new .mcap file after this much", "MiB", read_only=True, minimum=1, maximum=65536),
    Param("split_s", 600.0, "Start a new .mcap file after this time; 0: never", "s", read_only=True, minimum=0.0),
    Param("min_free_mib", 512, "Stop, with the bag complete, when the disk has less left", "MiB", minimum=16),
)


class RecorderNode(ManagedNode):
    """Services recorder/start, stop, pause, resume, split; credits the keep-all streams it records."""

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("recorder", PARAMS, **node_arguments)
        self._bag: RawBagWriter | None = None
        self._paused = False
        self._latched: dict[str, bytes] = {}
        """The newest message of each latched topic."""
        self._unwritten: dict[str, bytes] = {}
        """Those of them that came during a pause."""
        self._versions: set[int] = set()
        self._time_ns = 0
        self._last_message_s = 0.0

    def configure(self) -> None:
        self._files = named_files(self)
        self._rows = {name: _row(name) for name in self.param("topics")}
        self._gaps = {name: GapTracker() for name in self._rows if _base(name) in SEQUENCED}
        self._names: dict[str, str] = {}
        self._latched = {}
        for name, row in self._rows.items():
            credits = None
            if row.qos.history == HistoryPolicy.KEEP_ALL:
                base = _base(name)
                credits = ConsumerCredits(self, base, below=name.removesuffix(base))
                self.own(credits.close)
            subscription = self.create_subscription(
                row.type, name, partial(self._on_message, name, credits), _lossless(row.qos), raw=True
            )
            self._names[name] = subscription.topic_name
            self.own(self.destroy_subscription, subscription)
        self.serve(StartRecording, "recorder/start", self._on_start, counted="refused_starts")
        self.serve(StopRecording, "recorder/stop", self._on_stop)
        for name in ("pause", "resume", "split"):
            self.serve(Trigger, f"recorder/{name}", partial(self._on_trigger, name))
        timer = self.create_timer(FLUSH_S, self._on_timer, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.own(self.destroy_timer, timer)

    def activate(self) -> None:
        if self.param("record_at_start"):
            self._start(self._free_uri(str(self.param("bag_uri"))))

    def deactivate(self, reason: str) -> None:
        self._stop()

    def cleanup(self) -> None:
        self._stop()

    def is_settled(self, stop_s: float) -> bool:
        return self._bag is None or time.monotonic() - max(stop_s, self._last_message_s) > QUIET_S

    def update_diagnostics(self) -> None:
        self.diagnostics.gauge("bag", self._bag.path if self._bag is not None else "none")
        self.diagnostics.gauge("paused", self._paused)
        if self._bag is not None:
            self.diagnostics.gauge("messages", self._bag.messages)
            self.diagnostics.gauge("lost", sum(tracker.lost for tracker in self._gaps.values()))

    # Recording.

    def _on_message(self, name: str, credits: ConsumerCredits | None, data: bytes) -> None:
        self._last_message_s = time.monotonic()
        message = self._read(name, data)
        tracker = self._gaps.get(name)
        if tracker is not None:
            missing = tracker.observe(message.session, message.seq)
            if missing and self._bag is not None:
                self.diagnostics.count(f"gaps {name}", missing, text=f"{missing} messages of {name} missed")
        if self._rows[name].qos.durability == DurabilityPolicy.TRANSIENT_LOCAL:
            self._latched[name] = data
            if self._paused:
                self._unwritten[name] = data
        if not self._paused:
            self._write(name, data)
        if credits is not None and tracker is not None:
            credits.record_consumed(tracker)

    def _read(self, name: str, data: bytes) -> Any:
        """Raises WireError for what no reader of the bag could read, strict as it is: it does not belong in a bag."""
        try:
            message = m.deserialize(data, _msgtype(self._rows[name]))
        except SerdeError as error:
            raise WireError(ErrorCode.BAD_SHAPE, f"no reader of a bag can read it: {error}") from None
        if _base(name) == topics.SPEC.name:
            convert.spec_from_msg(message)
        return message

    def _write(self, name: str, data: bytes) -> None:
        if self._bag is None:
            return
        began = time.perf_counter()
        try:
            self._append(self._bag, name, data)
        except RecordingError as error:
            self._fail(error)
        self.diagnostics.latency("write", time.perf_counter() - began)

    def _append(self, bag: RawBagWriter, name: str, data: bytes) -> None:
        """Raises RecordingError where the disk refuses it."""
        self._time_ns = max(self._time_ns + 1, time.time_ns())
        if _base(name) == topics.POLICY_VERSION.name:
            self._versions.add(int(m.deserialize(data, topics.POLICY_VERSION.msgtype).version))
        bag.write(self._names[name], data, self._time_ns)

    def _start(self, uri: str) -> Path:
        """Open a bag and write into it the latched messages (spec, goal, policy) that still hold.

        Raises:
            BagError: one is open, or the name is taken.
            RecordingError: the disk refuses it.
        """
        if self._bag is not None:
            raise BagError(f"already recording to {self._bag.path}; call recorder/stop first")
        path = self.run_dir / uri if uri else self._next_path()
        self._check_free(path.parent)
        bag = self._bag = RawBagWriter(
            path, custom={"wm.run_id": self.run_dir.name}, split_bytes=int(self.param("split_mib")) * MIB,
            split_s=float(self.param("split_s")),
        )
        self._paused, self._time_ns, self._versions = False, 0, set()
        for tracker in self._gaps.values():  # they stay: what was granted must not be taken back
            tracker.clear_losses()
        self._unwritten.clear()
        for name, row in self._rows.items():
            bag.add_topic(self._names[name], _msgtype(row), [recorded_qos(row.qos)])
        try:
            for name, data in self._latched.items():
                self._append(bag, name, data)
        except RecordingError as error:
            self._fail(error)
            raise
        self.diagnostics.clear_condition("recording")
        self.get_logger().info(f"recording to {path}")
        return path

    def _resume(self, bag: RawBagWriter) -> None:
        """Go on, first with the latched messages that came during the pause. Raises RecordingError."""
        self._paused = False
        while self._unwritten:
            name = next(iter(self._unwritten))
            self._append(bag, name, self._unwritten.pop(name))

    def _stop(self) -> tuple[Path, int, int] | None:
        """Complete the bag; return its path, messages and losses, or None while not recording."""
        bag, self._bag = self._bag, None
        if bag is None:
            return None
        lost = {name: tracker for name, tracker in self._gaps.items() if tracker.lost}
        drops = {self._names[name]: {"lost": tracker.lost, "gaps": tracker.gaps} for name, tracker in lost.items()}
        bag.custom["wm.recorder_drops"] = json.dumps(drops)
        bag.custom.update(self._facts())
        messages, total = bag.messages, sum(tracker.lost for tracker in lost.values())
        path = bag.close()
        self._note_in_index(path, messages, total)
        self.get_logger().info(f"recorded {messages} messages to {path}, {total} missed")
        return path, messages, total

    def _facts(self) -> dict[str, str]:
        """custom_data taken from what was recorded: spec (the namespace's own before sim's), policy versions."""
        facts: dict[str, str] = {}
        specs = [name for name in self._latched if _base(name) == topics.SPEC.name]
        if specs:
            spec, _ = m.spec_of(m.deserialize(self._latched[min(specs, key=len)], topics.SPEC.msgtype))
            facts["wm.spec_json"] = m.spec_to_json(spec)
            facts["wm.world_model_sha256"] = spec.world_model_sha256
        return {**facts, "wm.policy_versions": json.dumps(sorted(self._versions))}

    def _free_uri(self, uri: str) -> str:
        """`uri`, or with _1, _2 ... behind it where an earlier recording, finished or killed, has that name."""
        if not uri:
            return uri
        for number in range(10_000):
            name = f"{uri.rstrip('/')}_{number}" if number else uri
            path = self.run_dir / name
            if not path.exists() and not path.with_name(path.name + PARTIAL_SUFFIX).exists():
                break
        if name != uri:
            self.get_logger().warning(f"bag {uri} exists from an earlier recording; recording to {name}")
            self.diagnostics.count("renamed_bags", text=f"bag {uri} exists; recording to {name}")
        return name

    def _next_path(self) -> Path:
        folder = self.run_dir / "bags"
        taken = {path.name.split(".")[0] for path in folder.glob("bag_*")}
        number = next(i for i in range(len(taken) + 1) if f"bag_{i:03d}" not in taken)
        return folder / f"bag_{number:03d}"

    def _note_in_index(self, path: Path, messages: int, lost: int) -> None:
        """run_dir/bags.json lists every completed bag of the run; where that fails, the bag is as good as before."""
        index = self.run_dir / "bags.json"
        uri = str(path.relative_to(self.run_dir)) if path.is_relative_to(self.run_dir) else str(path)
        row = {"bag": uri, "messages": messages, "lost": lost}
        try:
            rows = json.loads(index.read_text(encoding="utf-8")) if index.is_file() else []
            write_atomic(index, json.dumps([*rows, row], indent=1).encode())
        except (OSError, TypeError, ValueError) as error:
            text = f"bag {path} is complete, but {index} does not list it: {error}"
            self.get_logger().error(text)
            self.diagnostics.count("unlisted_bags", level=diagnostics.ERROR, text=text)

    def _on_timer(self) -> None:
        if self._bag is None:
            return
        try:
            self._bag.flush()
            self._check_free(self._bag.partial_path)
        except OSError as error:
            self._fail(error)

    def _check_free(self, folder: Path) -> None:
        existing = next(path for path in (folder, *folder.parents) if path.is_dir())
        free, least = shutil.disk_usage(existing).free // MIB, int(self.param("min_free_mib"))
        if free < least:
            raise RecordingError(f"only {free} MiB free in {existing}, less than min_free_mib={least}; free some space")

    def _fail(self, error: OSError) -> None:
        """Stop recording with one error; the bag is completed where the disk still allows it."""
        partial = self._bag.partial_path if self._bag is not None else None
        try:
            stopped = self._stop()
        except (BagError, RecordingError):
            stopped = None
        state = f"bag {stopped[0]} is complete up to here" if stopped else f"the bag is unfinished: {partial}"
        text = f"recording stopped: {error}; {state}"
        self.get_logger().error(text)
        self.diagnostics.set_condition("recording", diagnostics.ERROR, text)
        self.diagnostics.count("failed_recordings", level=diagnostics.ERROR, text=text)

    # Services.

    def _on_start(self, request: StartRecording.Request, response: StartRecording.Response) -> Any:
        self.require_active()
        uri = str(self._files.new(request.bag_uri, "bags")) if request.bag_uri else ""
        try:
            response.bag_uri = str(self._start(uri))
        except BagError as error:
            raise WireError(ErrorCode.BUSY, str(error)) from None
        return response

    def _on_stop(self, request: StopRecording.Request, response: StopRecording.Response) -> Any:
        try:
            stopped = self._stop()
        except RecordingError as error:
            response.error_code, response.message = ErrorCode.IO_ERROR, str(error)
            return response
        if stopped is None:
            response.error_code, response.message = ErrorCode.NOT_ACTIVE, "not recording; call recorder/start"
            return response
        path, response.messages, response.gaps = stopped
        response.bag_uri = str(path)
        return response

    def _on_trigger(self, name: str, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._bag is None:
            response.message = "not recording; call recorder/start"
            return response
        try:
            if name == "split":
                self._bag.split()
            elif name == "pause":
                self._paused = True
            else:
                self._resume(self._bag)
            response.success = True
        except RecordingError as error:
            self._fail(error)
            response.message = str(error)
        return response


def _base(name: str) -> str:
    """The row of the QoS table that a topic name ends with: sim/env/image is an env/image."""
    name = row_name(name)
    fitting = [row for row in TOPICS if name == row or name.endswith(f"/{row.lstrip('/')}")]
    return max(fitting, key=len, default=name)


def _row(name: str) -> GraphTopic:
    base = _base(name)
    if base not in TOPICS:
        raise ValueError(f"cannot record {name!r}; the graph's topics are {', '.join(sorted(TOPICS))}")
    return TOPICS[base]


def _msgtype(row: GraphTopic) -> str:
    return f"{row.type.__module__.split('.')[0]}/msg/{row.type.__name__}"


def _lossless(offered: QoSProfile) -> QoSProfile:
    """A keep-all subscription that every publisher of the row matches."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL, depth=0, reliability=offered.reliability, durability=offered.durability
    )


def main() -> None:
    sys.exit(run_node(RecorderNode))


if __name__ == "__main__":
    main()
