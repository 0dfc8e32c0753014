"""The curves of the live page, and what a run folder says: from its files alone, whether the run goes on or not."""

import base64
import json
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from wm_nodes.config.load import ConfigError, read_yaml
from wm_nodes.core.statistics import wilson_interval
from wm_nodes.core.types import UInt8Array
from wm_nodes.reports.clip_report import clip_panels
from wm_nodes.reports.curves import POLICY_PANELS, Panel
from wm_nodes.reports.live_page import LivePage
from wm_nodes.training.metrics import FILE_NAME, read_metrics
from wm_nodes.training.run_record import CONFIG
from wm_nodes.video_model.clips import load_clips

Points = dict[str, dict[int, list[float]]]
"""Metric, update, then its value alone or with the ends of its 95 % interval."""
SUCCESS, REAL = "success_rate", "real"
PANELS = (
    Panel("success (share of episodes)", {SUCCESS: "imagined", REAL: "real, 95 % interval"}, (0.0, 1.0)),
    *(panel for panel in POLICY_PANELS if SUCCESS not in panel.lines), *clip_panels(1),
)
DRAWN = {name for panel in PANELS for name in panel.lines}
MOST_POINTS = 400
"""Of one line; of more, some evenly apart are drawn."""
MOST_BAGS = 8
"""Bags of recordings that are held in memory for looking on."""
PICTURES, CURVES = "pictures", "curves.png"


def rate(successes: int, episodes: int) -> list[float]:
    """A share with the ends of its Wilson interval."""
    return [successes / episodes, *wilson_interval(successes, episodes)]


def charts(points: Points) -> list[dict[str, Any]]:
    """The panels that have points, as the page draws them."""
    return [
        {"title": panel.title, "limits": panel.limits, "lines": lines} for panel in PANELS
        if (lines := [{"label": label, "points": _thinned([[x, *y] for x, y in sorted(points[name].items())])}
                      for name, label in panel.lines.items() if points.get(name)])
    ]


class RunFolder:
    """Shows a run folder on a page. path: of the run, or of one of its rounds."""

    def __init__(self, path: Path) -> None:
        whole = path.absolute()
        self.path = whole.parent.parent if whole.parent.name == "rounds" else whole
        self._seen: object = None

    @property
    def settings(self) -> dict[str, Any]:
        """The run's; empty where config.yaml cannot be read."""
        try:
            return read_yaml(self.path / CONFIG)
        except ConfigError:
            return {}

    @cached_property
    def _clips(self) -> Any:
        """The recordings that loop 2 takes its contexts from, uint8 (N, F, H, W, 3)."""
        bags, settings = sorted((self.path / "data" / "train").glob("shard_*")), self.settings
        try:
            if 0 < len(bags) <= MOST_BAGS and not settings["groups"]["history"]:
                return load_clips(bags, settings["model"]["stride"], settings["clip_steps"]).frames.numpy()
        except (OSError, ValueError, KeyError):
            pass
        return ()

    def recorded_clip(self, context: int) -> UInt8Array | None:
        """The frames of a context of loop 2, uint8 (F, H, W, 3); None where they are too many to be kept, or begin
        elsewhere."""
        return self._clips[context] if context < len(self._clips) else None

    @property
    def threshold(self) -> float | None:
        """Of the done signal, above which an imagined episode ends; None where the run has none."""
        value = self.settings.get("reward", {}).get("success_threshold")
        return None if value is None else float(value)

    def show(self, page: LivePage) -> None:
        """Show what has changed since the last call. Raises whatever files make that are not of a run."""
        rounds = [folder for folder in (self.path / "rounds").glob("*") if folder.name.isdecimal()]
        trainings = sorted(rounds, key=lambda folder: int(folder.name)) or [self.path]
        files = [self.path / CONFIG, self.path / "summary.json", *sorted((self.path / PICTURES).glob("*.png"))]
        for one in trainings:
            files += [one / FILE_NAME, *sorted((one / "evaluations").glob("*.json"))]
        seen = [(file, file.stat().st_mtime_ns) for file in files if file.is_file()]
        if seen == self._seen:
            return
        self._seen, settings = seen, self.settings
        page.show("run", {
            "folder": str(self.path), "task": settings.get("task", ""), "video": "grpo" in settings,
            "finished": (self.path / "summary.json").is_file(),
            "updates": settings.get("ppo", {}).get("updates") or settings.get("iterations"),
        })
        page.show("charts", {"charts": charts(self._points(trainings))})
        page.show("strips", {"strips": [
            {"name": file.stem.replace("_", " "), "picture": base64.b64encode(file.read_bytes()).decode()}
            for file, _ in seen if file.suffix == ".png" and file.name != CURVES
        ]})

    def _points(self, trainings: Sequence[Path]) -> Points:
        """Of consecutive trainings, their updates counted on."""
        points, first = Points(), 0
        for folder in trainings:
            last = first
            for line in read_metrics(folder) if (folder / FILE_NAME).is_file() else ():
                section, step = line.pop("section"), first + int(str(line.pop("step")))
                last = max(last, step)
                for name, value in line.items():
                    for key in DRAWN & {f"{section}/{name}", *([name] if section == "ppo" else [])}:
                        if isinstance(value, (int, float)):
                            points.setdefault(key, {})[step] = [float(value)]
            for name, update in (("before", first), ("after", last)):
                if (file := folder / "evaluations" / f"real_{name}.json").is_file():
                    success = json.loads(file.read_text(encoding="utf-8"))["success"]
                    points.setdefault(REAL, {})[update] = rate(sum(success), len(success))
            first = last
        return points


def _thinned(points: list[list[float]]) -> list[list[float]]:
    """At most about MOST_POINTS of them, the last among them."""
    return points[:: -max(1, len(points) // MOST_POINTS)][::-1]
