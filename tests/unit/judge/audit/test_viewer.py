"""The page for people, in a real browser: keys, kept labels, the exported file, hostile texts, many clips."""

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from audit_logs import JudgeByClip, judge_all, moving_squares
from browser import Page, browser
from scripted_judge import BORDERLINE, CLEAN, POOR, UNUSABLE, WRONG, FaultyJudge, ScriptedJudge, clean_table

from setup.system import find_browser
from wm_nodes.apps.cli import main
from wm_nodes.judge.agent.judge import Read, ReadRequest
from wm_nodes.judge.agent.rubric import load_rubric
from wm_nodes.judge.audit.labels import read_labels
from wm_nodes.judge.audit.reading import read_record
from wm_nodes.judge.audit.viewer import page as page_text
from wm_nodes.judge.audit.viewer import write_view

RUBRIC = load_rubric("robot")
PROGRAM = find_browser()
needs_browser = pytest.mark.skipif(
    PROGRAM is None, reason="no Chromium found; apt-get install chromium-headless-shell (run_tests.py tries to)"
)
HOSTILE = "</script><script>window.hacked=1</script><img src=x onerror='window.hacked=2'>\u2028'\"`${window.hacked=3}"


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    assert PROGRAM is not None
    with browser(PROGRAM, tmp_path / "profile") as opened:
        opened.downloads(tmp_path)
        yield opened


def make_log(folder: Path, count: int, *, num_frames: int = 25) -> None:
    """Clip i is judged by table i mod 4: clean; blurred; poor, with votes; a confirmed pattern."""
    tables: list[dict[str, Any]] = [
        {}, {"clarity": WRONG}, {"planning": POOR, "robot": [BORDERLINE, WRONG, CLEAN, CLEAN]}, {"occlusion": UNUSABLE},
    ]
    jobs = moving_squares(count, num_frames)
    judges = {c.clip_id: ScriptedJudge(clean_table(RUBRIC, **tables[i % 4])) for i, (c, _) in enumerate(jobs)}
    judge_all(folder, JudgeByClip(judges), jobs, mode="benchmark", round_number=2)


def wait_for(path: Path, opened: Page) -> Path:
    """The download, once it is whole."""
    for _ in range(200):
        if path.is_file() and path.stat().st_size:
            return path
        opened.js("new Promise((done) => setTimeout(done, 50))")
    raise AssertionError(f"{path} was not downloaded")


def no_complaints(opened: Page) -> None:
    bad = ("Runtime.exceptionThrown", "Log.entryAdded", "Network.loadingFailed")
    assert [event for event in opened.events if event.get("method") in bad] == []


@needs_browser
def test_two_clips_are_labelled_with_keys_exported_and_compared(
    tmp_path: Path, page: Page, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log"
    make_log(log, 3)
    assert main(["audit", "sample", str(log), "--round", "2"]) == 0
    assert main(["audit", "view", str(log), "--sample", str(log / "sample-2.json")]) == 0
    page.open(log / "view.html")
    page.until("document.querySelector('.strip img').naturalWidth === 96")
    told = "[...document.querySelectorAll('main .good, main .bad')].map((node) => node.textContent)"
    assert page.js(told) == [], "what the judge says is not shown before"
    page.press("3", "p", "e", "f", "u")  # planning, clarity and its reason, brightness, color: each goes on
    assert page.js("row().name") == "temporal" and page.js(told) == ["pass", "pass", "pass"]
    page.press("ArrowRight", *["ArrowUp"] * 3)  # clip 1: clarity, which the judge fails
    for key, answer in (("f", "fail"), ("p", "pass")):
        page.press(key, "ArrowUp")
        assert page.js("labelsOf(clip()).clarity.answer") == answer
    page.press("1", "e", "e", "ArrowUp", "ArrowUp", "2")  # and planning
    page.press("7", "a", "d", *["ArrowDown"] * 3, "4", "ArrowUp", "x")  # no such keys; temporal, taken back
    for _ in range(100):  # the browser writes what it keeps behind the page's back
        page.open(log / "view.html")  # again: the browser has kept the labels
        if page.js("document.querySelector('header .faint').textContent") == "2 of 3 clips labelled":
            break
        page.js("new Promise((done) => setTimeout(done, 100))")
    assert page.js("document.querySelector('header .faint').textContent") == "2 of 3 clips labelled"
    page.press("s")
    assert "Type your name first" in page.js("document.querySelector('.banner').textContent")
    page.type("Ada L.")
    page.press("Enter", "s")
    path = wait_for(tmp_path / "labels-Ada-L-.json", page)
    no_complaints(page)
    labels = read_labels(path)
    assert labels.annotator == "Ada L."
    first, second = labels.labels
    assert {name: (row.answer, row.level, row.explanation) for name, row in first.rows.items()} == {
        "planning": ("pass", 3, None), "clarity": ("pass", None, True), "brightness": ("fail", None, None),
        "color": ("unsure", None, None),
    }
    assert {name: (row.answer, row.level, row.explanation) for name, row in second.rows.items()} == {
        "clarity": ("fail", 1, False), "planning": ("pass", 2, None),
    }
    capsys.readouterr()
    arguments = ["agree", str(log), "--labels", str(path), "--json", str(tmp_path / "agree.json")]
    assert main(["audit", *arguments]) == 0
    assert "agreement with people, round 2, 2 clips" in capsys.readouterr().out
    (found,) = json.loads((tmp_path / "agree.json").read_text())
    rows = {row["name"]: row for row in found["rows"]}
    assert (rows["clarity"]["n"], rows["clarity"]["accuracy"], rows["clarity"]["reasons_right"]) == (2, 1.0, 0.5)
    assert (rows["brightness"]["n"], rows["brightness"]["accuracy"]) == (1, 0.0)
    assert (rows["color"]["n"], rows["color"]["unsure"]) == (0, 1)
    assert rows["planning"]["accuracy"] == 0.5  # the judge says L3 both times, the person L3 and L2


@needs_browser
def test_texts_of_a_judge_stay_texts(tmp_path: Path, page: Page) -> None:
    class Hostile(ScriptedJudge):
        async def read(self, request: ReadRequest) -> list[Read]:
            return [replace(read, evidence_text=HOSTILE, reason=HOSTILE) for read in await super().read(request)]

    log = tmp_path / "log"
    ((clip, task),) = moving_squares(1)
    job = (replace(clip, clip_id=HOSTILE), replace(task, instruction=HOSTILE, robot=HOSTILE))
    judge_all(log, Hostile(clean_table(RUBRIC, occlusion=UNUSABLE)), [job])
    assert main(["audit", "view", str(log)]) == 0
    page.open(log / "view.html")
    page.press("3", "p", "p", "ArrowUp")
    assert page.js("window.hacked") is None
    assert page.js("document.querySelector('main h2').textContent") == HOSTILE
    assert page.js("document.querySelectorAll('script').length") == 2
    assert HOSTILE in page.js("document.querySelector('.row.now').textContent")
    assert page.js("document.querySelector('.pictures img').naturalWidth") == 96
    no_complaints(page)
    inline = page.js("(() => { const s = document.createElement('script'); s.textContent = 'window.hacked = 4';"
                     "document.body.append(s); return window.hacked; })()")
    assert inline is None  # the page's policy: nothing but its own script runs


@needs_browser
def test_clips_without_a_verdict_or_without_pictures_are_shown_as_such(tmp_path: Path, page: Page) -> None:
    log = tmp_path / "log"
    jobs = moving_squares(2)
    broken = replace(jobs[1][0], frames=np.full((4, 8, 8, 3), np.nan, np.float32))
    judge_all(log, FaultyJudge(clean_table(RUBRIC), "robot", "error"), [jobs[0], (broken, jobs[1][1])])
    assert main(["audit", "view", str(log)]) == 0
    page.open(log / "view.html")
    names, shown = "rows().map(({ name }) => name)", "document.querySelector('main').textContent"
    decided = page.js(names)
    assert "clarity" in decided and "robot" not in decided
    page.press(*["u"] * (len(decided) - 1))
    assert "finish_reason length" not in page.js(shown)
    page.press("u")
    assert "ERROR: robot: finish_reason length" in page.js(shown)
    page.press("r")
    assert "robot" in page.js(names) and "overall" in page.js(names)
    page.press("r")
    page.press("ArrowRight", " ", ".", " ")
    text = page.js("document.querySelector('main').textContent")
    assert "no pictures: the clip is malformed" in text and "frames hold pixels that are not finite" in text
    page.press("p")
    assert "The judge decided no row of this clip" in page.js("document.querySelector('.banner').textContent")
    no_complaints(page)


@needs_browser
def test_a_second_look_is_shown_with_what_it_changed_once_all_rows_are_labelled(tmp_path: Path, page: Page) -> None:
    log = tmp_path / "log"
    judge = ScriptedJudge(clean_table(RUBRIC, interaction=[WRONG, CLEAN]), second={"interaction": CLEAN})
    (verdict,) = judge_all(log, judge, moving_squares(1))
    assert verdict.reflections[0].accepted
    assert main(["audit", "view", str(log)]) == 0
    page.open(log / "view.html")
    page.press(*["u"] * page.js("rows().length"))
    shown = page.js("document.querySelector('main').textContent")
    assert "Second look: task_completion passed while interaction failed" in shown
    assert "interaction 0.25 → 1.00, accepted, frames 1 2" in shown and "cost: 22 reads" in shown
    no_complaints(page)


@needs_browser
def test_many_clips_load_only_the_pictures_that_are_seen(tmp_path: Path, page: Page) -> None:
    log = tmp_path / "log"
    make_log(log, 4, num_frames=60)
    record = read_record(log)
    evaluations = record.judged()
    names = [event["body"] for event in map(json.loads, (log / "log.jsonl").read_text().splitlines())
             if event["kind"] == "clip"]
    assert sum(len(body["frames"]) for body in names) == 240
    write_view(log / "view.html", record, [e for _ in range(150) for e in evaluations])
    page.open(log / "view.html")
    page.until("document.querySelector('.pictures img').naturalWidth === 96")
    assert page.js("document.querySelectorAll('nav button').length") == 600
    assert page.js("document.querySelectorAll('img').length") < 70
    pictures = [e for e in page.events if e.get("method") == "Network.requestWillBeSent"
                and e["params"]["request"]["url"].endswith(".png")]
    assert 0 < len(pictures) <= 64
    assert (
        page.js(
            "(() => { const t = performance.now(); for (let i = 0; i < 20; i += 1) show(i);"
            "return (performance.now() - t) / 20; })()"
        )
        < 250
    ), "ms per clip"
    no_complaints(page)


def test_the_page_asks_for_nothing_from_outside() -> None:
    text = page_text("a & b", {"clips": [], "page": "", "rubrics": {}})
    assert "<title>a &amp; b</title>" in text
    assert re.findall(r"(?:https?:)?//[a-z]", text.replace("// ", "")) == []
    assert "default-src &#x27;none&#x27;" in text
    assert not any(word in text for word in ("innerHTML", "insertAdjacentHTML", "document.write", "eval("))


def test_a_page_may_stand_elsewhere_and_a_log_elsewhere(tmp_path: Path) -> None:
    make_log(tmp_path / "a log", 1)
    out = tmp_path / "pages" / "one.html"
    assert main(["audit", "view", str(tmp_path / "a log"), "--output", str(out)]) == 0
    data = json.loads(out.read_text().split('id="data">')[1].split("</script>")[0])
    assert data["media"] == "../a%20log/media"
    picture = out.parent / data["media"].replace("%20", " ") / data["clips"][0]["frames"][0]
    assert picture.is_file()
    shutil.rmtree(tmp_path / "a log" / "media")
    assert main(["audit", "verify", str(tmp_path / "a log")]) == 1
