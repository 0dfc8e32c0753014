"""Evidence with calibrated bands makes the agent look closer: measured, refused, written as a pack, and at work."""

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from imagined_clip import STEPS, imagined
from judge_server import PickyServer
from recording_samples import make_episode, make_spec
from scripted_judge import make_clip, make_task

from wm_nodes.apps.cli import main
from wm_nodes.config.load import default_judge
from wm_nodes.config.schema import JudgeConfig
from wm_nodes.config.shipped import shipped_model
from wm_nodes.core.named_files import NamedFiles
from wm_nodes.core.types import UInt8Array
from wm_nodes.judge.agent.reflection import conflicting_evidence
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.agent.types import TaskSpec, clip_ref
from wm_nodes.judge.agent.verdict import Verdict
from wm_nodes.judge.audit.reading import read_record
from wm_nodes.judge.evidence_of_clip import ClipEvidence
from wm_nodes.judge.service import ClipJob, JudgeService
from wm_nodes.judge.training import normal_ranges
from wm_nodes.judge.training.normal_ranges import SIGNALS, bands_of, count_outside
from wm_nodes.recording import EpisodeBagWriter

MODEL_DIR = shipped_model("push_cube")
BANDS = {"still_energy": {"component": "temporal", "low": 1e-3}, "flicker_max": {"component": "temporal", "high": 0.1}}


def pack(folder: Path, **bands: dict[str, object]) -> Path:
    file = folder / "bands.yaml"
    quiet = {"voting": {"audit_share": 0.0}, "reflection": {"audit_share": 0.0}}
    file.write_text(json.dumps({"extends": "robot", "name": "bands", "evidence": bands, **quiet}))
    return file


def settings(server: PickyServer, rubric: Path) -> JudgeConfig:
    values = {"endpoints": [server.url], "model": "judge", "tries": 1, "rubric": str(rubric)}
    return JudgeConfig.model_validate({**default_judge().model_dump(), **values})


def job(name: str, frames: UInt8Array) -> ClipJob:
    task = TaskSpec("push the blue cube into the red target", "push_cube", "panda", frames[0], None, imagined()[1])
    return ClipJob(clip_ref(name, frames, 10.0), task)


def triggers(verdict: Verdict) -> list[str]:
    return [words for look in verdict.reflections for words in look.triggers if "against evidence" in words]


def test_a_clip_that_stands_still_against_its_actions_is_voted_on_and_looked_at_again(
    server: PickyServer, tmp_path: Path
) -> None:
    frames = imagined()[0]
    still = frames[:1].repeat(STEPS + 1, 0)
    still[1:, 0, 0] = 20 * np.arange(1, STEPS + 1, dtype=np.uint8)[:, None]  # one pixel changes: PRECHECK lets it pass
    rubric = pack(tmp_path, **BANDS)
    with closing(
        JudgeService(settings(server, rubric), seed=0, audit=tmp_path / "audit", evidence=ClipEvidence(MODEL_DIR))
    ) as judge:
        moving, frozen = judge.judge([job("moving", frames), job("frozen", still)])
    assert moving.valid and not triggers(moving)
    assert frozen.valid and triggers(frozen)[0].startswith("temporal passed against evidence still_energy")
    votes = {score.component: len(score.votes) for score in frozen.stages[0].components}
    assert votes["temporal"] > votes["clarity"] == 1, "only what the evidence speaks of is voted on"
    entries = {entry.clip_id: entry.evidence for entry in read_record(tmp_path / "audit").judged()}
    assert entries["frozen"]["still_energy"] < 1e-3 < entries["moving"]["still_energy"]
    assert entries["moving"]["flicker_max"] < 0.1


def test_what_cannot_be_measured_lies_in_no_band(server: PickyServer, tmp_path: Path) -> None:
    clip = make_clip()
    with closing(
        JudgeService(settings(server, pack(tmp_path, **BANDS)), seed=0, evidence=ClipEvidence(MODEL_DIR))
    ) as it:
        (other_camera,) = it.judge([ClipJob(clip, make_task(clip))])
        (malformed,) = it.judge([ClipJob(replace(clip, frames=clip.frames[:1]), make_task(clip))])
    assert any("still_energy nan" in words for words in triggers(other_camera))
    assert "a clip needs at least 2 frames, got 1" in malformed.reason


def test_bands_of_evidence_that_nobody_measures_are_refused_by_name(server: PickyServer, tmp_path: Path) -> None:
    unknown = pack(tmp_path, sharpnes={"component": "clarity", "low": 0.5})
    with pytest.raises(ValueError, match=r"bands of sharpnes, which is not measured here; known: .*sharpness_min"):
        JudgeService(settings(server, unknown), seed=0)
    needs_model = pack(tmp_path, **BANDS)
    with pytest.raises(ValueError, match=r"bands of still_energy, which a world model measures; name its folder"):
        JudgeService(settings(server, needs_model), seed=0)
    with closing(JudgeService(settings(server, Path("robot")), seed=0)) as judge:
        before = judge.rubric.version
        with pytest.raises(ValueError, match="still_energy"):
            judge.set_rubric("bands.yaml", NamedFiles(tmp_path))
        assert judge.rubric.version == before


def test_the_shipped_bands_are_measured_by_the_shipped_model_and_tell_a_frozen_clip() -> None:
    rubric, evidence = load_rubric("robot_push_cube"), ClipEvidence(MODEL_DIR)
    assert set(rubric.evidence) == set(SIGNALS) and rubric.stages == load_rubric().stages
    evidence.check(rubric)
    frozen = job("frozen", imagined()[0][:1].repeat(STEPS + 1, 0))
    found = conflicting_evidence(rubric, evidence.measure(rubric, frozen.clip, frozen.task))
    assert {"still_energy", "surprise_over_still"} <= set(found)


def rows(count: int) -> list[tuple[dict[str, float], bool]]:
    """Every signal of clip i is i; the task of every second clip is done."""
    return [(dict.fromkeys(SIGNALS, float(i)), i % 2 == 0) for i in range(count)]


def test_a_band_ends_where_so_many_clean_clips_lie_outside() -> None:
    bands = bands_of(rows(101), 0.02)
    assert bands["flicker_max"] == {"component": "temporal", "high": 98.0}
    assert bands["action_gain"] == {"component": "interaction", "low": 2.0}
    assert bands["done_max"] == {"component": "task_completion", "low": 2.0}  # of 0, 2, .. 100
    rubric = load_rubric(overrides={"evidence": bands})
    counts = count_outside(rows(101), rubric)
    assert (counts["flicker_max"], counts["action_gain"], counts["done_max"], counts["any"]) == (2, 2, 1, 4)
    with pytest.raises(ValueError, match="done_max needs 50 clips whose task is done, the bags hold 30"):
        bands_of(rows(60), 0.02)
    with pytest.raises(ValueError, match=r"below 0\.5, got 0\.7"):
        bands_of(rows(101), 0.7)


@pytest.mark.parametrize("stride", [1, 2])
def test_the_command_writes_a_pack_that_the_agent_reads(
    stride: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(normal_ranges, "LEAST", 2)
    spec = make_spec(height=64, width=128)
    with EpisodeBagWriter(tmp_path / "bag", spec, run_id="clean", start_ns=1) as bag:
        for index in range(4):
            episode = make_episode(spec, index, 4)
            bag.write(replace(episode, success=np.arange(5) >= (2 if index else 9)))
    output = tmp_path / "push.yaml"
    given = [str(MODEL_DIR), str(tmp_path / "bag"), "--check", str(tmp_path / "bag"), "--output", str(output)]
    assert main(["normal-ranges", *given, "--stride", str(stride)]) == 0
    said = capsys.readouterr().out
    rubric = load_rubric(str(output))
    assert set(rubric.evidence) == set(SIGNALS) and rubric.version in said and "any of them" in said
    ClipEvidence(MODEL_DIR).check(rubric)
    assert main(["normal-ranges", *given, "--stride", "0"]) == 2 and "--stride must be >= 1" in capsys.readouterr().err
    monkeypatch.setattr(normal_ranges, "LEAST", 9)
    assert main(["normal-ranges", *given]) == 2 and "name more bags" in capsys.readouterr().err
