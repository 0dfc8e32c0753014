"""The reward agent judges the episodes of a recorded run: whole ones, goals at hand, recorded rewards bit by bit."""

import json
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from judge_server import PickyServer
from numpy.typing import NDArray
from recording_graph import NUM_ENVS, Graph, write
from recording_samples import foreign_copy, make_spec
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from wm_nodes.apps.cli import main
from wm_nodes.config.judge import JudgeConfig
from wm_nodes.config.load import load_config
from wm_nodes.judge.rejudge import JudgedBag, judge_bag
from wm_nodes.judge.service import JudgeService
from wm_nodes.reward import RewardResult


@dataclass
class AgentGraph(Graph):
    """Publishes the rewards of `results`, by step, as the agent's."""

    results: dict[tuple[int, int], RewardResult] = field(default_factory=dict)
    version: int = 0
    tamper: int = -1
    silent: bool = False

    def reward(self, row: dict[str, NDArray[Any]], stamp_ns: int) -> Any:
        message = super().reward(row, stamp_ns)
        result = self.results.get((self.session, self.step_id))
        if result is not None:
            message.reward_name, message.reward_version = "agent", self.version
            message.total, message.valid = result.total, result.valid.astype(np.uint8)
            if self.silent:
                message.total = np.where(result.total > 0, np.float32(np.nan), result.total)
                message.valid = (result.valid & ~(result.total > 0)).astype(np.uint8)
            if self.step_id == self.tamper:
                message.total = np.nextafter(message.total, np.float32(10), dtype=np.float32)
        return message


def recorded(path: Path, **options: Any) -> Path:
    graph = AgentGraph(make_spec(num_envs=NUM_ENVS), **options)
    graph.rollout(1, 12)
    graph.rollout(2, 12)
    return write(path, graph)


def judged(bag: Path, server: PickyServer, reads: Path | None = None) -> tuple[JudgedBag, int]:
    from wm_nodes.judge.episode_reward import EpisodeReward

    values = {"endpoints": [server.url], "model": "judge", "tries": 1, "repeat_share": 0.0}
    settings = JudgeConfig.model_validate({**load_config("base").judge.model_dump(), **values})
    with closing(JudgeService(settings, seed=0, reads=reads)) as judge:
        return judge_bag(bag, judge), EpisodeReward(judge).version


def test_every_episode_that_ends_in_a_bag_is_judged_once_and_paid_at_its_end(
    server: PickyServer, tmp_path: Path
) -> None:
    found, _ = judged(recorded(tmp_path / "bag"), server)
    assert found.verdicts and all(verdict.valid for verdict in found.verdicts) and not found.unseen
    assert len({verdict.clip_id for verdict in found.verdicts}) == len(found.verdicts)
    paid = np.concatenate([result.total[result.total > 0] for result in found.results.values()])
    assert sorted(paid.tolist()) == sorted(float(np.float32(verdict.reward)) for verdict in found.verdicts)
    assert (found.compared, found.different) == (0, [])


@pytest.mark.slow
def test_rewards_that_the_agent_gave_come_out_again_and_one_unit_in_the_last_place_is_found(
    server: PickyServer, tmp_path: Path
) -> None:
    reads = tmp_path / "reads"
    first, version = judged(recorded(tmp_path / "plain"), server, reads)
    server.down = True  # the answers were kept
    again, _ = judged(recorded(tmp_path / "agent", results=first.results, version=version), server, reads)
    assert again.compared == len(first.results) and not again.different
    place = min(again.results)
    bent, _ = judged(
        recorded(tmp_path / "bent", results=first.results, version=version, tamper=place[1]), server, reads
    )
    assert bent.different == [place]
    quiet = recorded(tmp_path / "silent", results=first.results, version=version, silent=True)
    silent, _ = judged(quiet, server, reads)
    assert silent.unanswered == len(first.verdicts) and not silent.different, "an outage then is no difference now"
    other, _ = judged(recorded(tmp_path / "other", results=first.results, version=version + 1), server, reads)
    assert other.compared == 0, "rewards of another judge are not compared"


@pytest.mark.slow
def test_the_command_writes_a_line_per_episode_and_names_what_is_wrong(
    server: PickyServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, rows = recorded(tmp_path / "bag"), tmp_path / "rows.jsonl"
    given = [str(bag), "--judge", server.url, "--judge-model", "judge", "--json", str(rows)]
    assert main(["rescore", *given]) == 0
    said = capsys.readouterr().out
    lines = json.loads(rows.read_text())["episodes"]
    assert lines and all(line["status"] == "OK" and 0 < line["reward"] <= 1 for line in lines)
    assert f"{len(lines)} episodes judged ({len(lines)} OK)" in said and "0 recorded lock-steps" in said
    for plugin, mode in ((StoragePlugin.SQLITE3, CompressionMode.NONE), (StoragePlugin.MCAP, CompressionMode.FILE)):
        foreign = foreign_copy(bag, tmp_path / plugin.name, plugin, mode)
        assert main(["rescore", str(foreign), *given[1:]]) == 0, capsys.readouterr().err
        assert f"{len(lines)} episodes judged ({len(lines)} OK)" in capsys.readouterr().out
    assert main(["rescore", str(bag), "--judge-model", "judge"]) == 2 and "needs a judge" in capsys.readouterr().err
    assert main(["rescore", str(tmp_path / "none"), *given[1:]]) == 2 and "none" in capsys.readouterr().err
