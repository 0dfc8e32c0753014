"""Judge the episodes of a recorded bag by the reward agent, without a graph.

    python -m wm_nodes.apps.judge_episodes runs/RUN/bags/B --config runs/RUN/config.yaml --judge http://host:8000/v1 ...

With the answers that the run kept (judge.keep_reads) nobody is asked again, and its own rewards come out bit by bit.
Exit code: 0 done, 1 rewards of this judge, rubric and mode in the bag are others, 2 a clear error.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from wm_nodes.apps.policy_run import add_judge_options, judge_options
from wm_nodes.config.load import load_config
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.files import write_atomic
from wm_nodes.judge.agent import Status
from wm_nodes.judge.episode_reward import episode_judge
from wm_nodes.judge.evidence_of_clip import ClipEvidence
from wm_nodes.judge.rejudge import JudgedBag, judge_bag
from wm_nodes.judge.service import READS, JudgeService


def main(argv: Sequence[str]) -> int:
    """Print the verdicts' summary; see the module."""
    parser = argparse.ArgumentParser(prog="score_episodes", description=__doc__.splitlines()[0])
    parser.add_argument("bag", type=Path, help="a live recording with images")
    parser.add_argument("--config", default="cpu", help="a preset, or the run's config.yaml (default: cpu)")
    add_judge_options(parser)
    parser.add_argument("--namespace", help="of the environment, where the bag holds several")
    parser.add_argument("--model-dir", type=Path, help="world model whose evidence the rubric has bands of")
    parser.add_argument("--reads", type=Path, help="the judge's kept answers; default: judge_reads beside --config")
    parser.add_argument("--audit", type=Path, help="folder of an audit log to write")
    parser.add_argument("--json", type=Path, metavar="FILE", help="a line per episode")
    arguments = parser.parse_args(argv)
    try:
        found = _judged(arguments)
    except (ValueError, OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if arguments.json is not None:
        rows = [
            {"clip_id": v.clip_id, "status": v.status, "reward": v.reward if v.valid else None, "level": v.level,
             "reason": v.reason, "audit_id": v.audit_id}
            for v in found.verdicts
        ]
        write_atomic(arguments.json, "".join(json.dumps(row) + "\n" for row in rows).encode())
    counts = {status: sum(v.status is status for v in found.verdicts) for status in Status}
    told = ", ".join(f"{count} {status}" for status, count in counts.items() if count)
    print(f"{len(found.verdicts)} episodes judged ({told or 'none'}), {len(found.unseen)} not seen whole")
    for reason in found.unseen[:5]:
        print(f"  {reason}")
    print(
        f"{found.compared} recorded lock-steps are of this judge and rubric, {len(found.different)} of them differ; "
        f"not compared: {found.unanswered} rewards that were not given then"
    )
    return 1 if found.different else 0


def _judged(arguments: argparse.Namespace) -> JudgedBag:
    config = load_config(arguments.config, judge_options(arguments))
    beside = Path(arguments.config).parent / READS
    reads = arguments.reads or (beside if beside.is_dir() else None)
    evidence = ClipEvidence(arguments.model_dir or shipped_model(config.task))
    settings = episode_judge(config)
    with closing(
        JudgeService(settings, seed=config.seed, reads=reads, audit=arguments.audit, evidence=evidence)
    ) as judge:
        return judge_bag(arguments.bag, judge, namespace=arguments.namespace)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
