"""`wm view` of a recorded training and of a run folder, in a real browser: pictures, done signal, curves, verdicts,
nodes, and what is left of them after a reconnect."""

import json
import os
import signal
import subprocess
import sys
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Page, browser
from recording_graph import Graph
from recording_samples import make_spec

from setup.system import find_browser
from wm_msgs.msg import ClipBatch, ClipVerdict, EpisodeEvent, LearnerMetrics, RunState
from wm_nodes.apps.cli import main
from wm_nodes.config.load import dump_config, load_config
from wm_nodes.nodes.viewer.feed import Feed
from wm_nodes.nodes.viewer.run_folder import RunFolder
from wm_nodes.recording import RawBagWriter, topics
from wm_nodes.recording import messages as m
from wm_nodes.reports.film_strip import film_strip
from wm_nodes.reports.live_page import LivePage
from wm_nodes.training.metrics import MetricsWriter

PROGRAM = find_browser()
needs_browser = pytest.mark.skipif(
    PROGRAM is None, reason="no Chromium found; apt-get install chromium-headless-shell (run_tests.py tries to)"
)
PROCESS = "import sys; from wm_nodes.apps.cli import main; sys.exit(main(sys.argv[1:]))"
HOSTILE = "<img src=x onerror='window.hacked=1'></script><script>window.hacked=2</script>"
NOT_BLANK = """[...document.querySelectorAll('.side canvas')].map((canvas) => new Set(
    canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data).size)"""


def cdr(message: Any) -> bytes:
    """A message of rclpy's classes, with their defaults, as a recorder writes it."""
    values = {name: getattr(message, name) for name in message.get_fields_and_field_types()}
    values |= {"header": m.header(0, "")}
    values = {name: np.array(value) if isinstance(value, array) else value for name, value in values.items()}
    return m.serialize(m.message_type(f"wm_msgs/msg/{type(message).__name__}")(**values))


def write_training(path: Path) -> Path:
    """A bag as a training leaves it: imagined episodes, real ones, metrics, verdicts and heartbeats; 2 s long."""
    imagined = Graph(make_spec(3, 24, 32, source=0, env_id="wm/push_cube", instruction=HOSTILE))
    real = Graph(make_spec(3, 24, 32))
    for graph in (real, imagined):
        graph.rollout(1, 12)
    event = EpisodeEvent(kind=1, outcome=1, behaviour="before", source=1)
    verdict = ClipVerdict(
        clip_id="clip 7", status=0, reward=0.25, stages=["VQ", "IF"], stage_scores=[0.9, 0.1], stage_status=[0, 0],
        stage_passed=[1, 0], stage_vetoed_by=["", ""], component_reasons=[HOSTILE], component_p_fail=[0.9],
    )
    others: list[tuple[str, Any]] = [("/wm/sim/episode", event), ("/wm/reward/verdict", verdict)]
    others += [("/wm/learner/metrics", LearnerMetrics(update=u, success_rate=0.1 * u, loss_value=float("nan")))
               for u in range(1, 6)]
    others += [("/wm/run/state", RunState(node=f"/wm/{name}", state=1)) for name in ("learner", "environment")]
    clips = ClipBatch(contexts=[4, 9], group_size=1, num_frames=3)
    strip = np.random.default_rng(0).integers(0, 256, (2 * 24, 3 * 32, 3), np.uint8)
    with RawBagWriter(path) as bag:
        for namespace in ("/wm", "/wm/sim"):
            for topic in {*topics.ALL_TOPICS, *topics.VIDEO_TOPICS}:
                bag.add_topic(topics.absolute(namespace, topic), topic.msgtype, [topic.qos])
        messages = [(topics.absolute(space, topic), m.serialize(message), time_ns)
                    for space, graph in (("/wm/sim", real), ("/wm", imagined))
                    for topic, message, time_ns in graph.published]
        messages += [(name, cdr(message), 100_000_000) for name, message in others]
        messages += [("/wm/clips/image", m.serialize(m.image_message(strip, 0)), 100_000_000),
                     ("/wm/clips", cdr(clips), 100_000_000),
                     ("/wm/run/state", b"\x00\x01\x00\x00garbage", 200_000_000)]
        for name, data, time_ns in sorted(messages, key=lambda message: message[2]):
            bag.write(name, data, time_ns)
    return path


@contextmanager
def viewing(*words: str) -> Iterator[str]:
    """URL of the page of `wm view` in a process of its own; ended by Ctrl-C, with code 0."""
    process = subprocess.Popen(
        [sys.executable, "-c", PROCESS, "view", *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env=os.environ.copy(),
    )
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        assert line.startswith("live page http://127.0.0.1:"), line + process.stdout.read()
        yield line.split()[-1]
    finally:
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=60)
    assert process.returncode == 0, rest


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Page]:
    assert PROGRAM is not None
    with browser(PROGRAM, tmp_path / "profile") as page:
        yield page


def assert_no_complaints(page: Page) -> None:
    assert page.js("window.hacked") is None
    said = [event for event in page.events if event.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded")]
    assert [event for event in said if "Canvas2D" not in str(event)] == [], "of the canvas: that this test reads it"


@needs_browser
def test_a_recorded_training_is_shown_with_pictures_curves_verdicts_and_nodes(tmp_path: Path, opened: Page) -> None:
    bag = write_training(tmp_path / "bag")
    with viewing(str(bag), "--rate", "1000") as url:
        for _ in range(2):  # the second time after the end, from what the server keeps
            opened.open(url)
            opened.until("document.getElementById('state').textContent === 'recording, played to its end'")
            opened.until("document.querySelectorAll('#nodes code').length === 2")
            opened.until("document.querySelectorAll('#charts path.line').length")
            assert opened.js("[...document.querySelectorAll('.side[data-stream] h3')].map((h) => h.textContent)") == [
                "imagined by the model", "real: simulator"
            ]
            opened.until(f"({NOT_BLANK}).length === 4 && ({NOT_BLANK}).every((colours) => colours > 50)")
            assert opened.js("document.querySelector('.side.imagined path.line').getAttribute('d').length > 10")
            assert opened.js("document.querySelectorAll('.side.imagined .thumbs img').length") >= 2
            assert opened.js("document.querySelector('#charts path.line').getAttribute('d').split('L').length") == 5
            assert opened.js("document.querySelectorAll('#charts .real circle, #charts circle.real').length") == 1
            assert opened.js("[...document.querySelectorAll('#nodes code')].map((code) => code.textContent)") == [
                "/wm/environment", "/wm/learner"
            ]
            assert "1 of /wm/run/state" in opened.js("document.getElementById('foot').textContent")
            opened.until("document.querySelectorAll('#verdicts td').length")
            said = opened.js("document.getElementById('verdicts').textContent")
            assert "clip 7" in said and "fails" in said and "0.25" in said and HOSTILE in said
            assert HOSTILE in opened.js("document.getElementById('title').textContent")
            assert_no_complaints(opened)


@needs_browser
def test_a_run_folder_is_shown_from_its_files_also_while_they_grow(tmp_path: Path, opened: Page) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.yaml").write_text(dump_config(load_config("smoke")))
    metrics = MetricsWriter(run, tensorboard=False)
    for update in (1, 2):
        metrics.write("ppo", update, {"success_rate": 0.2 * update, "mean_return": 1.0, "loss_value": float("nan")})
    frames = np.random.default_rng(0).integers(0, 256, (3, 16, 16, 3), np.uint8)
    film_strip({"real": frames, "imagined": frames}, run / "pictures" / "film_strip_0.png")
    for name, successes in (("before", [0, 1]), ("after", [1, 1])):
        (run / "evaluations").mkdir(exist_ok=True)
        (run / "evaluations" / f"real_{name}.json").write_text(json.dumps({"success": successes}))
    with viewing(str(run)) as url:
        opened.open(url)
        opened.until("document.querySelectorAll('#charts .card').length === 2")
        assert opened.js("document.querySelectorAll('#charts circle.real').length") == 2
        assert opened.js("document.querySelectorAll('#charts circle.imagined').length") == 2 + 2
        opened.until("document.querySelector('#strips img').naturalWidth > 50")
        assert "push_cube" in opened.js("document.title")
        metrics.write("ppo", 3, {"success_rate": 0.9})
        opened.until("document.querySelectorAll('#charts circle.imagined').length === 3 + 2")
        beyond = """[...document.querySelectorAll('#charts circle')].filter(
            (circle) => circle.getAttribute('cx') > circle.ownerSVGElement.viewBox.baseVal.width - 8).length"""
        assert opened.js(beyond) == 0, "more updates than the settings say are inside of the axes, too"
        assert_no_complaints(opened)
    opened.until("document.getElementById('state').textContent.startsWith('not connected')")


def test_what_cannot_be_shown_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    foreign = tmp_path / "foreign"
    with RawBagWriter(foreign) as bag:
        bag.add_topic("/joint_states", "sensor_msgs/msg/JointState", [])
    with LivePage() as other:
        for words, said in (
            ([str(tmp_path / "none")], "no bag at"),
            ([str(foreign)], "nothing that the page shows: /joint_states; plain bags of a robot become ours by wm"),
            ([str(write_training(tmp_path / "bag")), "--port", str(other.port)], "in use; give another, or 0"),
            ([str(tmp_path / "bag"), "--rate", "0"], "rate must be above 0"),
        ):
            assert main(["view", *words]) == 2
            text = capsys.readouterr().err
            assert text.startswith("error: ") and text.count("\n") == 1 and said in text


def test_a_round_that_is_the_working_folder_is_of_its_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "rounds" / "2").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "rounds" / "2")
    assert RunFolder(Path(".")).path == tmp_path


def test_a_folder_that_is_no_run_is_counted_and_the_rest_is_shown(tmp_path: Path) -> None:
    (tmp_path / "rounds" / "last").mkdir(parents=True)
    (tmp_path / "config.yaml").write_text("reward: {success_threshold: 0.9}\nppo: 3\n")
    (tmp_path / "metrics.jsonl").write_text("[]\n")
    with LivePage() as page:
        feed = Feed(page, RunFolder(tmp_path))
        feed.put("/wm/run/state", cdr(RunState(node="/wm/learner", state=1)))
        assert feed.tick()
        assert feed.dropped == {"the run folder": 1}
        _, events = page.since(0, 1.0)
        assert b"/wm/learner" in events[0]


def test_what_makes_no_sense_is_dropped_and_counted_and_the_rest_is_shown() -> None:
    rng = np.random.default_rng(0)
    with LivePage() as page:
        feed = Feed(page)
        for topic in ("/wm/env/image", "/wm/env/transition", "/wm/episode", "/diagnostics", "/wm/clips"):
            for size in (0, 1, 4, 50, 3000):
                feed.put(topic, b"\x00\x01\x00\x00" + rng.bytes(size))
        assert sum(feed.dropped.values()) == 25
        feed.put("/wm/policy/version", b"of no interest")
        feed.put("/wm/run/state", cdr(RunState(node="/wm/learner", state=1)))
        feed.tick()
        _, events = page.since(0, 1.0)
        assert [json.loads(event[6:])["content"]["rows"][0]["node"] for event in events] == ["/wm/learner"]
        assert sum(feed.dropped.values()) == 25
