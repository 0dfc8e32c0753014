"""Everything a reward agent was asked and answered, in a log that cannot be changed unseen; and people's say on it.

with AuditLog(folder) as log:
    agent = AuditedAgent(judge, rubric, log, round_number=3)    # in place of RewardAgent(judge, rubric)
    verdict = await agent.evaluate(clip, task)

As a command: wm audit --help
"""
