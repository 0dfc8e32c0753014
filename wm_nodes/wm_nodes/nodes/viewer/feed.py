"""From messages, as bytes, to the panels of the live page: the same for a running graph and for a bag. No rclpy.

Shown is environment 0 of each namespace. A message that cannot be read is dropped and counted.
"""

import base64
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from wm_nodes.core.specs import SOURCE_IMAGINED, SOURCE_REAL, SOURCE_REPLAY, SOURCE_SIMULATOR
from wm_nodes.core.types import UInt8Array
from wm_nodes.nodes.viewer.run_folder import DRAWN, REAL, SUCCESS, Points, RunFolder, charts, rate
from wm_nodes.recording import messages as m
from wm_nodes.recording import topics
from wm_nodes.reports.live_page import LivePage

VIEW, DIAGNOSTICS = "env/image/view", "/diagnostics"
PICTURE_S, TABLE_S = 0.1, 0.5
"""Least time between two pictures of a panel, and between two tables: more often than a person looks."""
THUMBNAILS = 8
"""Pictures of the running episode that stay, about evenly apart."""
KEPT = 8
"""Pictures that wait for the step that they belong to."""
CLIPS, VERDICTS, NODES = 4, 12, 256
"""Newest clips and verdicts, and nodes, that are shown."""
MOST_STEPS = 10_000
SOURCES = {
    SOURCE_IMAGINED: "imagined by the model", SOURCE_SIMULATOR: "real: simulator", SOURCE_REAL: "real",
    SOURCE_REPLAY: "a recording",
}
METRICS = (SUCCESS, "mean_return", "kl_reference", "loss_value")
"""Of learner/metrics, beside those that travel by name."""
STATES = ("idle", "running", "finished", "failed")
STATUSES = ("ok", "skipped", "abstains", "error")
_RECORDED = (
    topics.SPEC, topics.IMAGES, topics.TRANSITION, topics.EPISODE, topics.LEARNER_METRICS, topics.RUN_STATE,
    topics.VERDICT, topics.CLIPS, topics.CLIP_IMAGES, topics.CLIP_SCORES,
)
TYPES = {topic.name: topic.msgtype for topic in _RECORDED} | {
    VIEW: topics.IMAGES.msgtype, DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
}
"""Topics that are shown, relative to a namespace, with their message types."""
PER_STEP = (VIEW, topics.IMAGES.name, topics.TRANSITION.name, topics.CLIPS.name, topics.CLIP_IMAGES.name)
"""Those of TYPES with pictures, or with a message for every step; nothing of them is missed where nobody looks."""


def row_of(topic: str) -> str:
    """The name that an absolute topic has in TYPES; empty: it is not shown."""
    return next((name for name in TYPES if topic == name or topic.endswith(f"/{name}")), "")


class Stream:
    """Environment 0 of one namespace, and the outcomes of all its environments.

    Args:
        panel: its name on the page.
        threshold: of the done signal, above which an imagined episode ends; None: not known.
    """

    def __init__(self, page: LivePage, panel: str, threshold: float | None) -> None:
        self._page, self._panel = page, panel
        self.about: dict[str, Any] = {"kind": "", "threshold": threshold, "steps": 1, "end": "", "behaviour": ""}
        self.size = (0, 0)
        """Height and width of a tile of env/image, px; 0 before its env/spec has come."""
        self.outcomes: dict[str, list[int]] = {}
        """Successful and all finished episodes of all environments, by who acted."""
        self._episode = (0, -1)
        self._signal: list[float] = []
        self._pictures: dict[int, UInt8Array] = {}
        self._steps: dict[int, int] = {}
        self._thumbnails: list[dict[str, Any]] = []
        self._shown: dict[str, Any] = {}
        self._shown_s = 0.0

    def spec(self, message: Any) -> None:
        spec, tiles = m.spec_of(message)
        self.size = tiles.tile_height, tiles.tile_width
        said = {"kind": SOURCES.get(spec.source, "real"), "imagined": spec.source == SOURCE_IMAGINED,
                "environment": spec.env_id, "cameras": spec.cameras, "steps": spec.max_episode_steps,
                "instruction": spec.instruction}
        self.about |= said
        if self._shown:  # pictures may come first: it is another topic
            self._shown |= said
            self._page.show(f"pictures {self._panel}", self._shown)

    def image(self, message: Any, size: tuple[int, int]) -> None:
        """size: height and width of environment 0 at the upper left, px."""
        pixels = np.asarray(message.data, np.uint8).reshape(message.height, message.width, 3)
        if not 0 < size[0] <= message.height or not 0 < size[1] <= message.width:
            raise ValueError(f"no tile of {size} px in a picture of {pixels.shape}")
        stamp = m.stamp_ns(message.header.stamp)
        self._pictures[stamp] = pixels[: size[0], : size[1]].copy()
        while len(self._pictures) > KEPT:
            del self._pictures[next(iter(self._pictures))]
        self._show(stamp)

    def transition(self, message: Any) -> None:
        if not message.valid[0]:
            return
        episode, step = (int(message.session), int(message.episode_id[0])), int(message.episode_step[0])
        if step > MOST_STEPS:
            raise ValueError(f"an episode of {step} steps")
        if episode != self._episode:
            self._episode, self._signal, self._thumbnails, self.about["end"] = episode, [], [], ""
            self._steps.clear()
        reached = m.stamp_ns(message.next_stamp)
        self._steps |= {m.stamp_ns(message.header.stamp): step, reached: step + 1}
        while len(self._steps) > KEPT:
            del self._steps[next(iter(self._steps))]
        if step < len(self._signal):
            return  # published twice
        self._signal += [float("nan")] * (step - len(self._signal)) + [float(message.success_probability[0])]
        ends = "", "done", "cut", "failed"
        self.about["end"] = ends[bool(message.terminated[0]) + 2 * bool(message.truncated[0])]
        for stamp in (m.stamp_ns(message.header.stamp), reached):
            self._show(stamp)

    def event(self, message: Any) -> None:
        if message.kind == m.KIND_END and message.outcome in (m.OUTCOME_SUCCESS, m.OUTCOME_FAILURE):
            counts = self.outcomes.setdefault(message.behaviour, [0, 0])
            self.outcomes[message.behaviour] = [counts[0] + (message.outcome == m.OUTCOME_SUCCESS), counts[1] + 1]
        if message.env_index == 0:
            self.about["behaviour"] = message.behaviour

    def show_outcomes(self) -> None:
        """Show what was shown last, with the outcomes of all episodes that have ended since."""
        ended = {**self.outcomes, "all": [sum(counts) for counts in zip(*self.outcomes.values())]}
        done = {who: ended[who] for who in (self.about["behaviour"], "all") if ended.get(who)}
        if self._shown and done != self._shown.get("outcomes"):
            self._shown["outcomes"] = done
            self._page.show(f"pictures {self._panel}", self._shown)

    def _show(self, stamp: int) -> None:
        """Show a picture whose step is known, unless another one was shown just now."""
        if stamp not in self._pictures or stamp not in self._steps:
            return
        step, now = self._steps[stamp], time.monotonic()
        last = bool(self.about["end"]) and step == len(self._signal)
        wanted = step >= (len(self._thumbnails) * self.about["steps"]) // (THUMBNAILS - 1) or last
        if (now - self._shown_s < PICTURE_S and not wanted) or step < (self._thumbnails or [{"step": 0}])[-1]["step"]:
            return
        self._shown_s, picture = now, png(self._pictures.pop(stamp))
        self._shown = {**self.about, "picture": picture, "step": step, "signal": [*self._signal]}
        self.show_outcomes()
        if wanted:
            self._thumbnails.append({"step": step, "picture": picture})
            self._page.show(f"thumbnails {self._panel}", {"pictures": self._thumbnails, "end": self.about["end"]})


class Feed:
    """Shows what comes on a page, and what the files of a run say.

    Args:
        folder: of the run, whose curves are drawn; None: those of learner/metrics are.
        namespace: nodes outside of it are not shown.
        clock: the time by which a node is silent, s.
    """

    def __init__(
        self, page: LivePage, folder: RunFolder | None = None, *, namespace: str = "/",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._page, self._folder, self._namespace, self._clock = page, folder, namespace, clock
        self._threshold = None if folder is None else folder.threshold
        self._streams: dict[str, Stream] = {}
        self._points: Points = {}
        self._update = 0
        self._nodes: dict[str, dict[str, Any]] = {}
        self._verdicts: deque[dict[str, Any]] = deque(maxlen=VERDICTS)
        self._clips: dict[str, Any] = {}
        self._shown_s = 0.0
        self.dropped = Counter[str]()
        """Messages that could not be read, by topic."""

    def put(self, topic: str, data: bytes) -> None:
        """A message, CDR bytes, of an absolute topic; of others than TYPES nothing is shown."""
        name = row_of(topic)
        if not name:
            return
        try:
            self._take(topic.removesuffix(name).rstrip("/"), name, m.deserialize(data, TYPES[name]))
        except Exception:  # whatever a foreign program sent: nothing ends for a picture
            self.dropped[topic] += 1

    def tick(self) -> bool:
        """Show the tables, and what the run's files say, if they are due; return whether they were. Called often."""
        now = time.monotonic()
        if now - self._shown_s < TABLE_S:
            return False
        self._shown_s = now
        ages = {name: self._clock() - node["heard_s"] for name, node in self._nodes.items()}
        rows = [{**node, "node": name, "age_s": max(0.0, ages[name])} for name, node in sorted(self._nodes.items())]
        for stream in self._streams.values():
            stream.show_outcomes()
        self._page.show("nodes", {"rows": rows, "dropped": dict(self.dropped)})
        if self._verdicts:
            self._page.show("verdicts", {"rows": [*self._verdicts][::-1]})
        if self._folder is not None:
            try:
                self._folder.show(self._page)
            except Exception:  # whatever stands in its files
                self.dropped["the run folder"] += 1
        elif self._points.keys() - {REAL}:
            self._page.show("charts", {"charts": charts(self._points)})
        return True

    def _take(self, namespace: str, name: str, message: Any) -> None:
        stream = self._streams.setdefault(namespace, Stream(self._page, namespace or "/", self._threshold))
        if name == topics.SPEC.name:
            stream.spec(message)
        elif name in (topics.IMAGES.name, VIEW):
            stream.image(message, stream.size if name == topics.IMAGES.name else (message.height, message.width))
        elif name == topics.TRANSITION.name:
            stream.transition(message)
        elif name == topics.EPISODE.name:
            stream.event(message)
            if not stream.about.get("imagined", True) and (outcomes := stream.outcomes.get(message.behaviour)):
                self._points.setdefault(REAL, {})[self._update] = rate(*outcomes)
        elif name == topics.LEARNER_METRICS.name:
            self._metrics(message)
        elif name == topics.RUN_STATE.name:
            self._hear(message.node, state=STATES[message.state])
        elif name == DIAGNOSTICS:
            for status in message.status:
                self._hear(status.name.partition(":")[0], level=int(status.level), message=status.message)
        elif name == topics.VERDICT.name:
            self._verdict(message)
        elif name == topics.CLIP_SCORES.name:
            totals = np.asarray(message.total)[np.asarray(message.valid, bool)]
            if totals.size:
                self._points.setdefault("grpo/reward_mean", {})[int(message.iteration)] = [float(totals.mean())]
        else:
            self._clips[name] = message
            if len({m.stamp_ns(part.header.stamp) for part in self._clips.values()}) == 1 < len(self._clips):
                self._show_clips(self._clips[topics.CLIPS.name], self._clips[topics.CLIP_IMAGES.name])

    def _hear(self, node: str, **facts: Any) -> None:
        if node.startswith(self._namespace) and (node in self._nodes or len(self._nodes) < NODES):
            self._nodes[node] = {**self._nodes.get(node, {}), **facts, "heard_s": self._clock()}

    def _metrics(self, message: Any) -> None:
        self._update = int(message.update)
        values = {name: getattr(message, name) for name in METRICS} | dict(zip(message.names, message.values))
        for name, value in values.items():
            if name in DRAWN and np.isfinite(value):
                self._points.setdefault(name, {})[self._update] = [float(value)]

    def _verdict(self, message: Any) -> None:
        stages = [
            {"stage": stage, "score": float(score), "status": STATUSES[status], "passed": bool(passed), "veto": veto}
            for stage, score, status, passed, veto in zip(
                message.stages, message.stage_scores, message.stage_status, message.stage_passed,
                message.stage_vetoed_by,
            )
        ]
        failing = [text for text, p in zip(message.component_reasons, message.component_p_fail) if text and p > 0.5]
        self._verdicts.append({
            "clip": message.clip_id, "status": STATUSES[message.status], "reward": float(message.reward),
            "stages": stages, "reason": message.reason or "; ".join(failing[:2]),
        })

    def _show_clips(self, batch: Any, image: Any) -> None:
        """The first clip of some contexts. image: a row per clip, a column per frame."""
        strip = np.asarray(image.data, np.uint8).reshape(image.height, image.width, 3)
        count, frames, clips = len(batch.contexts) * int(batch.group_size), int(batch.num_frames), []
        height = strip.shape[0] // count
        for row, context in zip(range(0, count, int(batch.group_size)), batch.contexts[:CLIPS]):
            clip = {"clip": row, "picture": png(strip[row * height : (row + 1) * height]), "recorded": ""}
            recorded = self._folder.recorded_clip(int(context)) if self._folder else None
            if recorded is not None and len(recorded) >= frames:
                clip["recorded"] = png(np.concatenate([*recorded[:frames]], 1))
            clips.append(clip)
        self._page.show("clips", {"iteration": int(batch.iteration), "frames": frames, "clips": clips})


def png(picture: UInt8Array) -> str:
    """An RGB picture as base64 of a PNG."""
    return base64.b64encode(cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes()).decode()
