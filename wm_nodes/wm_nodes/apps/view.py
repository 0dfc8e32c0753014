"""Show a recording or a run on a live page, which this host alone can open.

    wm view BAG [--rate 1] [--loop] [--port PORT]
    wm view RUN_FOLDER

A recording plays: imagined and real pictures, the done signal, curves, verdicts, nodes. Of a run folder the page shows
what its files say, and plays its newest recording. Ctrl-C ends it.
"""

import argparse
import time
from contextlib import suppress
from pathlib import Path

from wm_nodes.nodes.viewer.feed import TABLE_S, Feed, row_of
from wm_nodes.nodes.viewer.run_folder import RunFolder
from wm_nodes.recording import BagError
from wm_nodes.recording.bag import METADATA, Bag
from wm_nodes.recording.playback import Playback
from wm_nodes.reports.live_page import LivePage
from wm_nodes.training.run_record import CONFIG


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", type=Path, metavar="BAG|RUN_FOLDER", help="what to show")
    parser.add_argument("--rate", type=float, default=1.0, help="recorded seconds per second, e.g. 1000 (default: 1)")
    parser.add_argument("--loop", action="store_true", help="begin again at the end")
    parser.add_argument("--port", type=int, default=0, help="of the page (default: a free one)")


def run(arguments: argparse.Namespace) -> None:
    path: Path = arguments.path
    folder = RunFolder(path) if (path / CONFIG).is_file() else None
    bag = path if folder is None else newest_bag(folder.path)
    playback = None if bag is None else open_bag(bag, arguments.rate, loop=arguments.loop)
    with LivePage(arguments.port) as page:
        feed = Feed(page, folder, clock=lambda: playback.position_s if playback else 0.0)

        def look(ended: bool = False) -> None:
            if feed.tick() and playback is not None:
                page.show("playback", {
                    "bag": str(bag), "position_s": playback.position_s, "duration_s": playback.duration_s,
                    "rate": arguments.rate, "ended": ended,
                })

        print(f"live page {page.url}\nCtrl-C ends it", flush=True)
        with suppress(KeyboardInterrupt):
            if playback is not None:
                playback.run(feed.put, lambda time_ns: look(), say=print)
            while True:
                look(ended=True)
                time.sleep(TABLE_S)


def newest_bag(run_dir: Path) -> Path | None:
    """The last recording of a run's graph; None where there is none."""
    found = [*(run_dir / "bags").glob(f"*/{METADATA}")]
    return max(found, key=lambda file: file.stat().st_mtime_ns).parent if found else None


def open_bag(path: Path, rate: float, *, loop: bool) -> Playback:
    """Raises BagError where nothing in it can be shown."""
    with Bag(path) as bag:
        recorded = sorted({connection.topic for connection in bag.connections})
    names = [name for name in recorded if row_of(name)]
    if not names:
        raise BagError(
            f"bag {path} holds nothing that the page shows: {', '.join(recorded) or 'no topics'}; "
            "plain bags of a robot become ours by wm import rosbag"
        )
    return Playback(path, names=names, rate=rate, loop=loop)
