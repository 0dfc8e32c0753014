"""Record episodes and live graphs into rosbag2 (MCAP) bags, read them back, recover killed recordings."""

from wm_nodes.recording.bag import Bag
from wm_nodes.recording.errors import BagError, RecordingError
from wm_nodes.recording.raw import RawBagWriter
from wm_nodes.recording.reader import BagReport, check_spec, read_episodes, read_spec
from wm_nodes.recording.recovery import recover
from wm_nodes.recording.rollouts import read_rollouts
from wm_nodes.recording.writer import EpisodeBagWriter

__all__ = [
    "Bag", "BagError", "BagReport", "EpisodeBagWriter", "RawBagWriter", "RecordingError", "check_spec",
    "read_episodes", "read_rollouts", "read_spec", "recover",
]
