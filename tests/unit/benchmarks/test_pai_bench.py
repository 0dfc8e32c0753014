"""PAI-Bench's protocol as a command: videos, questions, a chat server, and vision backbones from local folders."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from chat_server import ChatServer, Fault
from judge_server import serving

from benchmarks.judge.comparisons import pai_bench as pai
from benchmarks.judge.pai_bench import metrics_of
from wm_nodes.apps.cli import main
from wm_nodes.judge.agent.types import clip_ref
from wm_nodes.judge.clip_files import read_video
from wm_nodes.video_rl.frame_features import load_backbone

transformers = pytest.importorskip("transformers", reason="the vision backbones need requirements/video.txt")
RNG = np.random.default_rng(0)


def backbone(folder: Path) -> Path:
    config = transformers.DINOv3ViTConfig(
        image_size=32, patch_size=16, hidden_size=32, intermediate_size=64, num_hidden_layers=1, num_attention_heads=2
    )
    transformers.DINOv3ViTModel(config).save_pretrained(folder)
    return folder


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    """Two videos: robot_1 stands still, robot_2 is noise; conditioning images; a question on each."""
    for name in ("videos", "images", "vqa"):
        (tmp_path / name).mkdir()
    still = RNG.integers(0, 256, (64, 64, 3), np.uint8)
    noise = list(RNG.integers(0, 256, (8, 64, 64, 3), np.uint8))
    for name, frames in (("robot_1", [still] * 8), ("robot_2", noise)):
        writer = cv2.VideoWriter(
            str(tmp_path / "videos" / f"{name}.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 4.0, (64, 64)
        )
        for frame in frames:
            writer.write(frame)
        writer.release()
        cv2.imwrite(str(tmp_path / "images" / f"{name}.png"), still)
        entry = {"uid": f"{name}-0", "question": "Is the cube moved?", "answer": "A", "task": "space",
                 "index2ans": {"A": "Yes", "B": "No"}}
        (tmp_path / "vqa" / f"{name}.json").write_text(json.dumps([entry]))
    return tmp_path / "videos"


def test_a_local_backbone_gives_the_consistency_metrics(tmp_path: Path) -> None:
    features = load_backbone(backbone(tmp_path / "dino"))
    still = RNG.integers(0, 256, (1, 32, 32, 3), np.uint8).repeat(5, 0)
    noise = RNG.integers(0, 256, (5, 32, 32, 3), np.uint8)
    same = metrics_of(clip_ref("same", still, 4.0), still[0], {"subject": features})
    assert same == pytest.approx({"subject_consistency": 100.0, "i2v_subject": 100.0})
    other = metrics_of(clip_ref("other", noise, 4.0), None, {"subject": features, "background": features})
    assert other["subject_consistency"] == other["background_consistency"] < 99.99 and "i2v_subject" not in other


def test_the_command_measures_what_it_is_given_and_names_what_is_missing(
    videos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dino, output = backbone(tmp_path / "dino"), tmp_path / "found.json"
    server = ChatServer()
    server.faults.extend([Fault("reply", text="Yes."), Fault("reply", text="no")])
    with serving(server):
        given = [str(videos), "--questions", str(tmp_path / "vqa"), "--url", server.url, "--model", "judge",
                 "--subject", str(dino), "--background", str(dino), "--images", str(tmp_path / "images"),
                 "--json", str(output)]
        assert main(["benchmark", "judge", "pai-bench", *given]) == 0
        said = capsys.readouterr().out
        assert "no Quality and no Overall: aesthetic_quality, imaging_quality" in said and "answered: 2" in said
        found = json.loads(output.read_text())
        assert found["scores"]["domain"] == 50 and found["videos"] == 2
        assert [sum(p["type"] == "image_url" for p in r["messages"][-1]["content"]) for r in server.requests] == [4, 4]
        others = {name: 90.0 for name in pai.QUALITY if name not in found["scores"]}
        (tmp_path / "others.json").write_text(json.dumps(others))
        server.faults.extend([Fault("reply", text="Yes."), Fault("reply", text="no")])
        assert main(["benchmark", "judge", "pai-bench", *given, "--metrics", str(tmp_path / "others.json")]) == 0
    whole = json.loads(output.read_text())["scores"]
    assert whole["overall"] == pytest.approx((50 + np.mean([whole[name] for name in pai.QUALITY])) / 2)


def test_what_cannot_be_measured_is_one_clear_error(
    videos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(*given: str) -> str:
        assert main(["benchmark", "judge", "pai-bench", *given]) == 2
        return capsys.readouterr().err

    assert "holds no .mp4" in refused(str(tmp_path))
    assert "nothing to measure" in refused(str(videos))
    assert "--url and --model together" in refused(str(videos), "--questions", str(tmp_path / "vqa"))
    assert "has no config.json" in refused(str(videos), "--subject", str(tmp_path))
    (videos / "broken.mp4").write_bytes(b"no video")
    with pytest.raises(ValueError, match=r"broken\.mp4 is no readable video: 0 frames"):
        read_video(videos / "broken.mp4")
    (videos / "broken.mp4").unlink()
    (tmp_path / "images" / "robot_2.png").unlink()
    dino = str(backbone(tmp_path / "dino"))
    assert "has no readable robot_2" in refused(str(videos), "--subject", dino, "--images", str(tmp_path / "images"))
