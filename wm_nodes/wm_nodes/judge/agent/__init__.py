"""The reward agent: plans, gates, votes and reflects over one Judge (RA-1 to RA-16)."""

from wm_nodes.judge.agent.contract import check_one_judge, pause_reason
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.rubric import Rubric, load_rubric
from wm_nodes.judge.agent.types import (
    Capabilities,
    ClipRef,
    Judge,
    JudgeError,
    Read,
    ReadRequest,
    Stage,
    Status,
    TaskSpec,
    Verdict,
    Vote,
    clip_ref,
)

__all__ = [
    "Capabilities",
    "ClipRef",
    "Judge",
    "JudgeError",
    "Read",
    "ReadRequest",
    "RewardAgent",
    "Rubric",
    "Stage",
    "Status",
    "TaskSpec",
    "Verdict",
    "Vote",
    "check_one_judge",
    "clip_ref",
    "load_rubric",
    "pause_reason",
]
