"""Metrics of a run: lines survive a resume and a crash; what is not a number is null, not 0."""

import json
import math
from contextlib import closing
from pathlib import Path

from wm_nodes.training.metrics import FILE_NAME, MetricsWriter, read_metrics


def test_a_resumed_run_appends_and_sections_are_read_apart(tmp_path: Path) -> None:
    with closing(MetricsWriter(tmp_path, tensorboard=False)) as writer:
        writer.write("ppo", 1, {"loss": 0.5})
    with closing(MetricsWriter(tmp_path, tensorboard=False)) as writer:
        writer.write("sft", 1, {"loss": 2})
        writer.write("ppo", 2, {"loss": 0.25})
    assert [line["loss"] for line in read_metrics(tmp_path, "ppo")] == [0.5, 0.25]
    assert len(read_metrics(tmp_path)) == 3


def test_values_that_are_not_finite_are_null_in_valid_json(tmp_path: Path) -> None:
    with closing(MetricsWriter(tmp_path, tensorboard=False)) as writer:
        writer.write("ppo", 1, {"a": math.nan, "b": math.inf, "c": 0.0})
    line = json.loads((tmp_path / FILE_NAME).read_text(), parse_constant=lambda name: name)
    assert line == {"section": "ppo", "step": 1, "a": None, "b": None, "c": 0.0}


def test_a_line_cut_by_a_crash_is_left_out_and_takes_no_other_with_it(tmp_path: Path) -> None:
    with closing(MetricsWriter(tmp_path, tensorboard=False)) as writer:
        writer.write("ppo", 1, {"loss": 0.5})
    with open(tmp_path / FILE_NAME, "a") as file:
        file.write('{"section": "ppo", "st')
    assert len(read_metrics(tmp_path)) == 1
    with closing(MetricsWriter(tmp_path, tensorboard=False)) as writer:
        writer.write("ppo", 2, {"loss": 0.25})
    assert [line["loss"] for line in read_metrics(tmp_path)] == [0.5, 0.25]


def test_tensorboard_holds_the_same_scalars(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    with closing(MetricsWriter(tmp_path)) as writer:
        writer.write("ppo", 3, {"loss": 0.5, "missing": math.nan})
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(event.step, event.value) for event in events.Scalars("ppo/loss")] == [(3, 0.5)]
    assert events.Tags()["scalars"] == ["ppo/loss"]
