"""A judge that answers from an audit log: it recomputes verdicts bit for bit, or under a rubric with other numbers.

The answers are the recorded ones. A rubric with other weights, thresholds, votes or caps may need a read that was not
recorded, e.g. of a stage behind a gate that is now open: such a clip gets an ERROR that names the question. Logs of
benchmark mode hold a read of every component.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from wm_nodes.judge.agent.judge import Capabilities, Cost, Health, Judge, JudgeError, MediaItem, Read, ReadRequest, Vote
from wm_nodes.judge.agent.machine import RewardAgent
from wm_nodes.judge.agent.rubric import Rubric
from wm_nodes.judge.agent.types import Component
from wm_nodes.judge.agent.verdict import Verdict, content_hash
from wm_nodes.judge.audit.entries import typed
from wm_nodes.judge.audit.log import AuditError, AuditLog
from wm_nodes.judge.audit.reading import Ask, Failure, Record, RecordedEvaluation, Subject
from wm_nodes.judge.audit.recording import AuditedAgent, RecordingJudge

QuestionKey = tuple[str, str, tuple[Component, ...], tuple[Vote, ...], tuple[MediaItem, ...]]
ReadKey = tuple[str, str, Component, Vote, tuple[MediaItem, ...]]


class ReplayJudge:
    """Answers from evaluations of one clip and task by one judge; the first answer to a question counts.

    Raises:
        ValueError: no one judge.
    """

    def __init__(self, evaluations: Sequence[RecordedEvaluation]) -> None:
        judges = {evaluation.agent.capabilities.judge_id for evaluation in evaluations}
        if len(judges) != 1:
            raise ValueError(f"a replay needs evaluations of one judge, got {', '.join(sorted(judges)) or 'none'}")
        self._capabilities = evaluations[0].agent.capabilities
        self._asks: dict[QuestionKey, Ask] = {}
        self._reads: dict[ReadKey, Read] = {}
        for evaluation in evaluations:
            for ask in evaluation.asks:
                self._asks.setdefault((evaluation.sha256, ask.stage, ask.components, ask.votes, ask.media), ask)
                for read in ask.reads:
                    key = (evaluation.sha256, ask.stage, read.component, read.vote, ask.media)
                    self._reads.setdefault(key, read)

    @property
    def capabilities(self) -> Capabilities:
        """Of the judge that was recorded."""
        return self._capabilities

    async def health(self) -> Health:
        return Health(True, "answers from an audit log")

    async def read(self, request: ReadRequest) -> list[Read]:
        """The recorded answers, however asked together. Raises JudgeError: never asked; or the recorded error."""
        sha, stage, media = request.clip.sha256, str(request.stage), request.media
        ask = self._asks.get((sha, stage, request.components, request.votes, media))
        if ask is not None:
            if ask.failure is not None:
                raise _rebuild_error(ask.failure)
            return list(ask.reads)
        wanted = [(sha, stage, name, vote, media) for name in request.components for vote in request.votes]
        if missing := [key for key in wanted if key not in self._reads]:
            names = ", ".join(f"{name}, vote {vote.index}" for _, _, name, vote, _ in missing)
            raise JudgeError(f"the log has no answer on {names}; ask the judge itself")
        return [self._reads[key] for key in wanted]


def _rebuild_error(failure: Failure) -> Exception:
    """An exception that reads like the one that was recorded."""
    if failure.error == JudgeError.__name__:
        return JudgeError(failure.reason, typed(Cost, failure.cost))
    kind: type[Exception] = type(failure.error, (Exception,), {})
    return kind(failure.reason)


@dataclass(frozen=True)
class ReplayResult:
    """A verdict and the same worked out again."""

    evaluation: RecordedEvaluation
    """What was judged."""
    before: Verdict
    """As it was recorded."""
    after: Verdict | None
    """Worked out again; None where it ran out of time, which nothing repeats."""

    @property
    def equal(self) -> bool:
        """All but clocks and costs is the same; of a verdict that held a secret, as it was written down."""
        return self.after is not None and self.after.audit_id == content_hash(self.before)


async def replay_evaluation(record: Record, evaluation: RecordedEvaluation) -> ReplayResult:
    """Work one verdict out again. Raises AuditError: the evaluation has no verdict, or a picture is missing."""
    if any(ask.failure and ask.failure.error == "CancelledError" for ask in evaluation.asks):
        return ReplayResult(evaluation, evaluation.verdict, None)
    settings: Mapping[str, Any] = evaluation.agent.settings
    agent = RewardAgent(ReplayJudge([evaluation]), record.rubric(evaluation), **settings)
    verdict = await agent.evaluate(record.clip(evaluation), record.task(evaluation), evaluation.evidence)
    return ReplayResult(evaluation, evaluation.verdict, verdict)


async def reaggregate(
    record: Record, evaluations: Iterable[RecordedEvaluation], rubric: Rubric, log: AuditLog
) -> list[Verdict]:
    """Work verdicts out under another rubric and write them, with all they rest on, into a log of their own.

    A question that an evaluation did not put may be answered by another one of its clip and task by the same agent.

    Raises:
        AuditError: `rubric` asks in other words, or a picture is missing.
    """
    alike: dict[tuple[int, Subject], list[RecordedEvaluation]] = {}
    for each in record.judged():
        alike.setdefault((each.agent.number, record.subject(each)), []).append(each)

    def judge_of(evaluation: RecordedEvaluation) -> tuple[Judge, Rubric]:
        check_questions(record.rubric(evaluation), rubric)
        others = alike[evaluation.agent.number, record.subject(evaluation)]
        return ReplayJudge([evaluation, *others]), rubric

    return await judge_again(record, evaluations, judge_of, log)


async def judge_again(
    record: Record, evaluations: Iterable[RecordedEvaluation],
    judge_of: Callable[[RecordedEvaluation], tuple[Judge, Rubric]], log: AuditLog,
) -> list[Verdict]:
    """Judge the clips of a log once more, each as its agent was set then, and write that into a log of its own.

    Args:
        judge_of: who judges, and by which rubric, which is one per agent.

    Raises:
        AuditError: a picture is missing.
    """
    agents: dict[int, AuditedAgent] = {}
    verdicts = []
    for evaluation in evaluations:
        number, (judge, rubric) = evaluation.agent.number, judge_of(evaluation)
        if number not in agents:
            agents[number] = AuditedAgent(judge, rubric, log, **evaluation.agent.settings)
        agents[number].judge, agents[number].round_number = RecordingJudge(judge, log), evaluation.round_number
        clip, task = record.clip(evaluation), record.task(evaluation)
        verdicts.append(await agents[number].evaluate(clip, task, evaluation.evidence))
    return verdicts


def check_questions(before: Rubric, after: Rubric) -> None:
    """Refuse a rubric that puts other questions. Raises AuditError: names what reads differently, or is new."""
    old, new = dict(_questions(before)), dict(_questions(after))
    if changed := [name for name, words in new.items() if old.get(name) != words]:
        raise AuditError(
            f"rubric {after.version} asks about {', '.join(changed)} in other words than {before.version} did; old "
            "answers cannot be counted for it: ask the judge again"
        )


def _questions(rubric: Rubric) -> Iterator[tuple[str, tuple[str, ...]]]:
    yield "planning", (rubric.planning.question, *rubric.planning.levels)
    entries = [item for stage in rubric.stages.values() for item in stage.components.items()]
    for name, entry in (*entries, *rubric.hack.patterns.items()):
        yield name, (entry.question, entry.defect, *entry.levels)
