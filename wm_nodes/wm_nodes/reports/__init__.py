"""What a run leaves for people: film strips, curves, a table with intervals, report.html and summary.json.

Plain arrays and numbers go in; nothing here knows a model, a policy or a graph.
"""

from wm_nodes.reports.clip_report import (
    ClipSummary,
    ScoreChange,
    clip_panels,
    scores_table,
    write_clip_report,
    write_clip_summary,
)
from wm_nodes.reports.curves import Panel, curves
from wm_nodes.reports.film_strip import film_strip
from wm_nodes.reports.gains import mean_gain
from wm_nodes.reports.html import Picture, write_report
from wm_nodes.reports.machine import machine_facts
from wm_nodes.reports.summary import SuccessRate, Summary, read_summary, write_summary
from wm_nodes.reports.tables import results_table, rounds_table

__all__ = [
    "ClipSummary",
    "Panel",
    "Picture",
    "ScoreChange",
    "SuccessRate",
    "Summary",
    "clip_panels",
    "curves",
    "film_strip",
    "machine_facts",
    "mean_gain",
    "read_summary",
    "results_table",
    "rounds_table",
    "scores_table",
    "write_clip_report",
    "write_clip_summary",
    "write_report",
    "write_summary",
]
