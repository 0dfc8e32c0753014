"""Everything a reward agent was asked and answered, in a log that cannot be changed unseen; and people's say on it.

with AuditLog(folder) as log:
    agent = AuditedAgent(judge, rubric, log, round_number=3)    # in place of RewardAgent(judge, rubric)
    verdict = await agent.evaluate(clip, task)

As a command: wm audit --help
"""

from wm_nodes.judge.audit.log import AuditError, AuditLog
from wm_nodes.judge.audit.people import HumanJudge
from wm_nodes.judge.audit.reading import Record, read_record, verify
from wm_nodes.judge.audit.recording import AuditedAgent, RecordingJudge, write_exchange
from wm_nodes.judge.audit.replay import ReplayJudge, replay_evaluation

__all__ = [
    "AuditError",
    "AuditLog",
    "AuditedAgent",
    "HumanJudge",
    "Record",
    "RecordingJudge",
    "ReplayJudge",
    "read_record",
    "replay_evaluation",
    "verify",
    "write_exchange",
]
