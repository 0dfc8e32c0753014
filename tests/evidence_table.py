"""The published table of the judge's evidence: docs/embedded_judge_evidence.csv."""

import csv
from pathlib import Path

TABLE = Path(__file__).parents[1] / "wm_nodes" / "docs" / "embedded_judge_evidence.csv"

with open(TABLE, newline="", encoding="utf-8") as file:
    EVIDENCE = {row["name"]: (float(row["low"]), float(row["high"])) for row in csv.DictReader(file)}
"""Name -> (low, high): no clip gives a number outside of them."""
