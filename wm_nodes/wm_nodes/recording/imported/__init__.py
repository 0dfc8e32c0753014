"""Plain ROS bags, of any robot, into ours, as a contract says: read its topics, plan episodes, write them."""

from wm_nodes.recording.imported.contract import Contract, load_contract
from wm_nodes.recording.imported.survey import Survey, survey
from wm_nodes.recording.imported.writing import write

__all__ = ["Contract", "Survey", "load_contract", "survey", "write"]
