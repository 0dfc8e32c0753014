"""What a run leaves for people: pictures, tables, report.html and summary.json."""

import io
import json
import re
from contextlib import closing
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from wm_nodes.reports.clip_report import (
    TITLES,
    UNREWARDED_TITLES,
    ClipSummary,
    ScoreChange,
    clip_panels,
    clip_verdict,
    scores_table,
    write_clip_report,
)
from wm_nodes.reports.curves import Panel, curves, read_series
from wm_nodes.reports.film_strip import STEP_MS, film_strip, moving_picture
from wm_nodes.reports.html import Picture, write_report
from wm_nodes.reports.machine import machine_facts
from wm_nodes.reports.stages import Stages, say_files
from wm_nodes.reports.summary import (
    FILE_NAME,
    SuccessRate,
    Summary,
    as_first_made,
    read_readings,
    read_summary,
    write_summary,
)
from wm_nodes.reports.tables import (
    EXPLOIT_COLUMNS,
    exploit_rows,
    exploit_table,
    result_rows,
    task_rows,
    tasks_table,
    verdict,
)
from wm_nodes.training.metrics import MetricsWriter
from wm_nodes.video_rl.heldout_metrics import UNREWARDED

PAIRED = {"difference": 0.25, "low": 0.157, "high": 0.348, "gained": 79, "lost": 28}
SUMMARY = Summary(
    task="push_cube", preset="cpu", seed=3, imagined_steps_per_s=412.3,
    real_before=SuccessRate(64, 200, 0.259, 0.388), real_after=SuccessRate(114, 200, 0.5, 0.64),
    imagined_before=SuccessRate(90, 256, 0.296, 0.412), imagined_after=SuccessRate(201, 256, 0.731, 0.831),
    bag="/runs/a/bags/training", paired=PAIRED, samples=40960, minutes=9.7, command="python3 online_rl.py --task <x>",
    machine={"processor": "P & Q"},
    acceptance={
        "passed": False, "outcome": "failed",
        "episodes": 96, "notes": ["a note"], "metrics": {"tool_ratio_h16": 0.1, "auc": None},
        "criteria": [
            {"name": "tool error", "value": 0.1, "threshold": 0.3, "rule": "<=", "outcome": "passed",
             "remedy": "nothing"},
            {"name": "recall", "value": None, "threshold": 0.6, "rule": ">=", "outcome": "failed",
             "remedy": "more data"},
        ],
    },
)


SAME = ScoreChange(0.5, 0.5, 0.0, -0.1, 0.1, "")
CLIPS = ClipSummary(
    "push_cube", "smoke", 3, iterations=6, version=12, contexts=48, evaluations=3,
    watched=("success", "outcome"),
    scores=dict.fromkeys(TITLES, SAME) | {"tracking": ScoreChange(0.5, 0.6, 0.1, 0.05, 0.15, "better")},
    hacked=[{"step": 6, "reward_slope": 0.1, "slopes": {"scenery": -0.2}, "text": "scenery gets <worse>"}],
    bag="/runs/b/bags/x", machine={"processor": "P & Q"},
)


def frames(count: int, value: int = 0, height: int = 8, width: int = 10) -> np.ndarray:
    """Frame t of one colour: (value + t, value, value)."""
    images = np.full((count, height, width, 3), value, np.uint8)
    images[..., 0] += np.arange(count, dtype=np.uint8)[:, None, None]
    return images


def blocks_of(picture: np.ndarray, colour: tuple[int, int, int]) -> int:
    return int((picture == np.array(colour, np.uint8)).all(-1).sum())


def test_a_film_strip_enlarges_each_shown_frame_as_it_is(tmp_path: Path) -> None:
    picture = film_strip({"real": frames(4, 40)}, tmp_path / "strip.png", scale=3)
    for t in range(4):
        assert blocks_of(picture, (40 + t, 40, 40)) == 8 * 10 * 9
    on_disk = cv2.cvtColor(cv2.imread(str(tmp_path / "strip.png")), cv2.COLOR_BGR2RGB)
    np.testing.assert_array_equal(on_disk, picture)


def test_a_long_film_strip_shows_first_and_last_frame_and_even_steps_between() -> None:
    picture = film_strip({"real": frames(17, 40)}, scale=1, max_columns=5)
    shown = [t for t in range(17) if blocks_of(picture, (40 + t, 40, 40))]
    assert shown == [0, 4, 8, 12, 16]


def test_a_run_of_several_tasks_shows_the_real_success_of_each(tmp_path: Path) -> None:
    found = {"successes_before": 12, "successes_after": 20, "episodes": 40}
    found |= {"difference": 0.2, "low": 0.05, "high": 0.35}
    summary = replace(SUMMARY, by_task={"push": found, "pull": {**found, "difference": -0.1}})
    assert task_rows(summary)[0] == ("push", "12 / 40", "20 / 40", "+20.0 (+5.0 to +35.0)")
    assert len(tasks_table(summary).rows) == 2
    write_summary(tmp_path, summary)
    assert read_summary(tmp_path)["by_task"]["pull"]["difference"] == -0.1
    page = write_report(tmp_path, summary, [], config_text="").read_text()
    assert "Real success by task" in page and "-10.0 (+5.0 to +35.0)" in page
    assert "Real success by task" not in write_report(tmp_path, SUMMARY, [], config_text="").read_text()


@pytest.mark.parametrize("others", [{}, {"imagined": 8}, {"imagined": 6}, {"imagined": 1}])
def test_a_marked_step_is_shown_and_framed_in_green(others: dict[str, int]) -> None:
    rows = {"real": frames(17, 40)} | {name: frames(17, 90) for name in others}
    picture = film_strip(rows, scale=4, max_columns=5, marks={"real": 7, **others})
    assert blocks_of(picture, (47, 40, 40)), "the step of the first row is shown"
    one = blocks_of(film_strip({"real": frames(17, 40)}, scale=4, marks={"real": 7}), (30, 170, 80))
    assert one and blocks_of(picture, (30, 170, 80)) == one * len(rows)


def test_a_goal_of_one_frame_stands_under_the_last_column_and_short_rows_stay_empty() -> None:
    picture = film_strip({"real": frames(3, 40), "short": frames(2, 90), "goal": frames(1, 140)}, scale=1)
    columns = {name: np.flatnonzero((picture == np.array(c, np.uint8)).all(-1).any(0)) for name, c in
               (("last", (42, 40, 40)), ("goal", (140, 140, 140)))}
    np.testing.assert_array_equal(columns["last"], columns["goal"])
    assert not blocks_of(picture, (92, 90, 90))


def test_a_moving_picture_plays_episodes_beside_each_other_and_keeps_the_last_frame_of_one_that_ended(
    tmp_path: Path,
) -> None:
    blue, red = (np.zeros((3, 8, 10, 3), np.uint8) for _ in range(2))
    blue[..., 2], red[..., 0] = (np.array([100, 170, 240])[:, None, None] for _ in range(2))
    episodes = [{"real": blue, "imagined": blue}, {"real": red[:2], "imagined": red[:2]}]
    moving_picture(episodes, tmp_path / "moving.gif", scale=4, marks=[{"imagined": 1}, {}])
    with Image.open(tmp_path / "moving.gif") as moving:
        assert moving.n_frames == 3 and moving.info["loop"] == 0 and moving.info["duration"] == STEP_MS
        for step, frames_of in enumerate(((blue[0], red[0]), (blue[1], red[1]), (blue[2], red[1]))):
            moving.seek(step)
            shown = np.asarray(moving.convert("RGB")).astype(int)
            areas = [(np.abs(shown - frame[0, 0]) < 12).all(-1).sum() for frame in frames_of]
            green = (np.abs(shown - (30, 170, 80)) < 12).all(-1).any()
            assert min(areas) > 0.8 * 2 * 8 * 10 * 16 and green == (step >= 1), step
    with pytest.raises(ValueError, match="at least one episode"):
        moving_picture([], tmp_path / "none.gif")


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ({}, "at least one row"),
        ({"real": frames(2).astype(np.float32)}, "row 'real' must be uint8"),
        ({"real": frames(2)[0]}, "row 'real' must be uint8"),
        ({"real": frames(2), "imagined": frames(2, height=4)}, "one image size"),
    ],
)
def test_a_film_strip_of_unfit_frames_is_refused(rows: dict[str, np.ndarray], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        film_strip(rows)


def metrics_file(folder: Path, lines: list[object]) -> Path:
    path = folder / "metrics.jsonl"
    path.write_text("\n".join(line if isinstance(line, str) else json.dumps(line) for line in lines))
    return path


def test_a_series_keeps_the_last_value_of_a_repeated_step_and_survives_a_cut_line(tmp_path: Path) -> None:
    path = metrics_file(tmp_path, [
        {"section": "ppo", "step": 1, "success_rate": 0.2}, {"section": "sft", "step": 1, "loss": 3.0},
        {"section": "ppo", "step": 2, "success_rate": None}, {"section": "ppo", "step": 1, "success_rate": 0.3},
        '{"section": "ppo", "st',
    ])
    series = read_series(path, "success_rate")
    assert series[0] == (1, 0.3) and series[1][0] == 2 and np.isnan(series[1][1])


def test_curves_are_drawn_from_what_is_there_and_not_at_all_from_nothing(tmp_path: Path) -> None:
    path = metrics_file(tmp_path, [{"section": "ppo", "step": i, "success_rate": i / 4} for i in range(4)])
    drawn = curves(path, tmp_path / "curves.png")
    assert drawn is not None and cv2.imread(str(drawn)).shape[1] > 800
    assert curves(metrics_file(tmp_path, []), tmp_path / "none.png") is None
    assert curves(tmp_path / "missing.jsonl", tmp_path / "none.png") is None
    assert not (tmp_path / "none.png").exists()


def test_a_metric_that_was_never_a_number_is_not_in_the_legend(tmp_path: Path) -> None:
    def drawn(lines: dict[str, str], name: str) -> np.ndarray:
        rows = [{"section": "grpo", "step": i, "reward": i / 4, "held": None} for i in range(4)]
        picture = curves(metrics_file(tmp_path, rows), tmp_path / name, (Panel("reward", lines),))
        return cv2.imread(str(picture))

    both = drawn({"reward": "trained on", "held": "held out"}, "both.png")
    assert np.array_equal(both, drawn({"reward": "trained on"}, "one.png"))
    assert not np.array_equal(both, drawn({"reward": "held out"}, "other.png"))


def test_the_table_holds_counts_percent_intervals_and_the_paired_difference() -> None:
    before, after, difference = result_rows(SUMMARY)
    assert (before.real.count, before.real.percent) == ("64 / 200", "32.0 %")
    assert before.real.interval == "95 %: 25.9 to 38.8 %"
    assert (after.imagined.count, after.imagined.percent) == ("201 / 256", "78.5 %")
    assert (difference.real.percent, difference.real.interval) == ("+25.0 points", "95 %: +15.7 to +34.8")
    assert difference.imagined.interval == "not paired"


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [(0.01, 0.3, "got better"), (-0.3, -0.01, "got worse"), (-0.1, 0.3, "chance"), (0.0, 0.3, "chance")],
)
def test_the_verdict_follows_the_interval_and_not_the_difference(low: float, high: float, words: str) -> None:
    assert words in verdict(replace(SUMMARY, paired=PAIRED | {"low": low, "high": high}))


def test_the_exploit_meter_is_in_table_report_summary_and_curves_where_there_are_readings(tmp_path: Path) -> None:
    known = {
        "episodes": 32.0, "imagined_success": 1.0, "replayed_success": 0.75, "real_success": 0.5, "precision": 0.75,
        "precision_low": 0.579, "precision_high": 0.867, "recall": 1.0, "recall_low": 0.862, "recall_high": 1.0,
    }
    unknown = known | {"imagined_success": 0.0, "precision": float("nan")}
    with closing(MetricsWriter(tmp_path, tensorboard=False)) as writer:
        for step, reading in ((0, unknown), (4, unknown), (4, known)):  # step 4 again, after a resume
            writer.write("exploit_meter", step, reading)
    summary = replace(SUMMARY, exploit_meter=read_readings(tmp_path), stopped=("after update 4 <only> 75%",))
    first, last = exploit_rows(summary)
    assert len(first) == len(EXPLOIT_COLUMNS) and (first[0], first[4]) == ("0", "undefined")
    assert last == ("4", "100.0 %", "75.0 %", "50.0 %", "75.0 % (57.9 to 86.7)", "100.0 % (86.2 to 100.0)")
    assert "after update 4 <only> 75%" in str(exploit_table(summary).caption)
    text = write_report(tmp_path, summary).read_text()
    assert "Exploit meter: success of 32 episodes" in text and "75.0 % (57.9 to 86.7)" in text
    assert "Training ended early: after update 4 &lt;only&gt; 75%." in text
    write_summary(tmp_path, summary)
    assert read_summary(tmp_path)["exploit_meter"][1]["precision"] == 0.75
    assert "xploit meter" not in write_report(tmp_path, SUMMARY).read_text()
    assert curves(tmp_path / "metrics.jsonl", tmp_path / "curves.png") is not None


def test_a_rate_without_episodes_is_refused() -> None:
    with pytest.raises(ValueError, match="got 3 of 2"):
        SuccessRate(3, 2)


def test_summary_json_has_the_promised_keys_and_no_nan(tmp_path: Path) -> None:
    write_summary(tmp_path, replace(SUMMARY, minutes=float("nan")))
    values = read_summary(tmp_path)
    assert (values["task"], values["preset"], values["seed"], values["bag"]) == ("push_cube", "cpu", 3, SUMMARY.bag)
    assert values["real_before"]["successes"] == 64 and values["real_after"]["episodes"] == 200
    assert values["imagined_before"]["episodes"] == 256 and values["imagined_after"]["successes"] == 201
    assert values["imagined_steps_per_s"] == 412.3 and values["minutes"] is None
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]


def test_a_summary_names_its_bag_from_the_run_folder_which_can_be_moved(tmp_path: Path) -> None:
    bag = tmp_path / "run" / "bags" / "training_120000"
    bag.mkdir(parents=True)
    path = write_summary(tmp_path / "run", replace(SUMMARY, bag=str(bag)))
    assert json.loads(path.read_text())["bag"] == "bags/training_120000" and str(tmp_path) not in path.read_text()
    assert read_summary(tmp_path / "run")["bag"] == str(bag)
    moved = (tmp_path / "run").rename(tmp_path / "moved")
    assert read_summary(moved)["bag"] == str(moved / "bags" / "training_120000")
    (moved / FILE_NAME).write_text((moved / FILE_NAME).read_text().replace('"bags/', f'"{tmp_path}/run/bags/'))
    assert read_summary(moved)["bag"] == str(moved / "bags" / "training_120000"), "an older one, moved"


@pytest.mark.parametrize("summary", [SUMMARY, CLIPS], ids=["loop 1", "loop 2"])
def test_a_finished_run_that_is_run_again_keeps_its_summary(tmp_path: Path, summary: Summary | ClipSummary) -> None:
    bag = tmp_path / "run" / "bags" / "training"
    bag.mkdir(parents=True)
    summary = replace(summary, bag=str(bag), minutes=12.0)
    path = write_summary(tmp_path / "run", summary)
    written = path.read_bytes(), path.stat().st_mtime_ns
    again = as_first_made(tmp_path / "run", replace(summary, minutes=0.2, command="again", machine={"processor": "Q"}))
    write_summary(tmp_path / "run", again)
    assert again == summary and (path.read_bytes(), path.stat().st_mtime_ns) == written
    other = replace(summary, seed=4, minutes=0.3, command="other")
    assert as_first_made(tmp_path / "run", other) == other, "other results are of the newest call"
    assert as_first_made(tmp_path / "new", other) == other
    moved = (tmp_path / "run").rename(tmp_path / "moved")
    assert as_first_made(moved, replace(summary, minutes=0.2)) == replace(summary, bag=str(moved / "bags" / "training"))


def test_an_unfinished_run_has_no_summary_and_the_error_says_so(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"summary.json does not exist: the run has not come to its end"):
        read_summary(tmp_path)


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.sources += [value or "" for name, value in attributes if name in ("src", "href")]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_report_is_one_file_with_its_pictures_inside(tmp_path: Path) -> None:
    film_strip({"real": frames(3)}, tmp_path / "strip.png")
    moving_picture([{"real": frames(3)}], tmp_path / "moving.gif")
    pictures = [Picture(name, "what", tmp_path / name) for name in ("strip.png", "moving.gif")]
    path = write_report(tmp_path, SUMMARY, pictures, config_text="seed: 3")
    text = path.read_text()
    page = _Page()
    page.feed(text)
    assert not page.open
    assert [source.split(",")[0] for source in page.sources] == ["data:image/png;base64", "data:image/gif;base64"]
    assert not re.search(r"https?://|<script", text)
    for part in ("got better", "64 / 200", "recall", "more data", "undefined", SUMMARY.bag, "seed: 3",
                 "--task &lt;x&gt;", "P &amp; Q", "a note"):
        assert part in text
    assert "nothing" not in text
    assert "40960 imagined environment steps at 412 per second,\n9.7 minutes" in text
    assert "Play the bag" not in text
    again = write_report(tmp_path, SUMMARY, again="replay 'bag_uri:=/a b'").read_text()
    assert "Play the bag" in again and "<pre>replay &#39;bag_uri:=/a b&#39;</pre>" in again
    untimed = write_report(tmp_path, replace(SUMMARY, imagined_steps_per_s=float("nan"))).read_text()
    assert "40960 imagined environment steps,\n9.7 minutes" in untimed


def test_a_report_of_a_missing_picture_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"gone.png"):
        write_report(tmp_path, SUMMARY, [Picture("Strip", "", tmp_path / "gone.png")])
    assert not (tmp_path / "report.html").exists()


def test_the_report_of_loop_2_shows_scores_alarms_and_how_to_do_it_again(tmp_path: Path) -> None:
    film_strip({"before": frames(3)}, tmp_path / "strip.png")
    pictures = [Picture("Strip", "what", tmp_path / "strip.png")]
    text = write_clip_report(tmp_path, CLIPS, pictures, config_text="seed: 3").read_text()
    page = _Page()
    page.feed(text)
    assert not page.open and len(page.sources) == 1
    for part in ("Better: tracking score (n = 48 held-out contexts).", "+0.1000 (+0.0500 to +0.1500)",
                 "scenery gets &lt;worse&gt;", f"retrain {tmp_path}", "P &amp; Q"):
        assert part in text
    write_summary(tmp_path, CLIPS)
    values = read_summary(tmp_path)
    assert values["scores"]["tracking"]["after"] == 0.6 and values["minutes"] is None
    (spaced := tmp_path / "a run").mkdir()
    assert f"retrain &#39;{spaced}&#39;" in write_clip_report(spaced, CLIPS).read_text()
    quiet = write_clip_report(tmp_path, replace(CLIPS, hacked=())).read_text()
    assert "No alarm in 3 held-out evaluations of task done at the end, outcome score" in quiet


def test_what_was_not_looked_at_is_not_measured_and_never_an_empty_list(tmp_path: Path) -> None:
    change = replace(SAME, before=0.25, after=0.125, verdict="worse")
    missing = {"reader_success": "no <reader>"}
    some = replace(CLIPS, hacked=None, unrewarded={"executed_success": change}, executed=24, not_measured=missing)
    text = write_clip_report(tmp_path, some).read_text()
    terminal = io.StringIO()
    Console(file=terminal, width=240).print(scores_table(some))
    for told in (text.replace("&lt;", "<").replace("&gt;", ">"), terminal.getvalue()):
        assert "executed: task done (n = 24)" in told and "0.1250" in told
        assert told.count("not measured") == 2 and "no <reader>" in told
        assert "Worse: executed: task done. Not measured: task done, other reader" in told
    assert "Not watched: 3 held-out evaluations while training are fewer than the alarm compares" in text
    write_summary(tmp_path, some)
    assert read_summary(tmp_path)["hacked"] is None and read_summary(tmp_path)["not_measured"] == missing
    assert set(UNREWARDED_TITLES) == set(UNREWARDED)


def test_scores_that_got_better_and_worse_are_named_apart() -> None:
    worse = {"scenery": replace(SAME, verdict="worse")}
    both = clip_verdict(replace(CLIPS, scores={**CLIPS.scores, **worse}))
    assert both == "Better: tracking score. Worse: scenery error (n = 48 held-out contexts)."
    none = clip_verdict(replace(CLIPS, scores=dict.fromkeys(TITLES, SAME)))
    assert none.startswith("No difference that chance does not explain")


def test_a_series_of_a_section_leaves_out_the_others_and_panels_without_numbers_are_not_drawn(tmp_path: Path) -> None:
    path = metrics_file(tmp_path, [
        {"section": "grpo", "step": 1, "reward": 3.0}, {"section": "heldout", "step": 1, "reward": 0.2},
        {"section": "heldout", "step": 2, "reward": None},
    ])
    assert read_series(path, "grpo/reward") == [(1, 3.0)]
    assert [step for step, _ in read_series(path, "heldout/reward")] == [1, 2]
    reward = Panel("reward", {"grpo/reward": "a", "heldout/reward": "b"})
    for known, rows in ((1, 1), (3, 2)):
        panels = (*[reward] * known, *clip_panels(2)[4:])
        drawn = curves(path, tmp_path / "curves.png", panels, step="buffers")
        assert drawn is not None and cv2.imread(str(drawn)).shape[0] == 297 * rows, "panels without a number"
    assert curves(path, tmp_path / "none.png", clip_panels(2)[4:]) is None


def test_paths_are_printed_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "runs[old]" / ("long " * 20)
    Stages()(f"run folder {folder.parent}")
    say_files(folder / "report.html", folder / "summary.json", str(folder / "bags[/b]"))
    first, *files = capsys.readouterr().out.splitlines()
    assert "runs[old]" in first
    assert files == [f"report   {folder}/report.html", f"summary  {folder}/summary.json", f"bag      {folder}/bags[/b]"]


def test_machine_facts_name_date_processor_and_versions() -> None:
    facts = machine_facts()
    assert {"date", "processor", "cores", "memory", "system", "python", "torch"} <= facts.keys()
    assert all(facts.values())
