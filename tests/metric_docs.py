"""What wm_nodes/docs/metrics.md explains, for tests that compare it with what runs write."""

import re
from pathlib import Path

import wm_nodes

DOCUMENT = Path(wm_nodes.__file__).parents[1] / "docs" / "metrics.md"


def documented(section: str) -> set[str]:
    """The names before the colons of the list under the heading that holds `section`."""
    parts = re.split(r"^## ", DOCUMENT.read_text(encoding="utf-8"), flags=re.M)
    (part,) = [part for part in parts if section in part.splitlines()[0]]
    rows = [line.split(": ")[0] for line in part.splitlines() if line.startswith("- `")]
    return {name for row in rows for name in re.findall(r"`([^`]+)`", row)}


def written(line: dict[str, object], scores: set[str]) -> set[str]:
    """The names in a line of metrics.jsonl as the document has them: <k> of an update or step, <score> of a score."""
    names = {re.sub(r"_\d+$", "_<k>", name) for name in line if name not in ("section", "step")}
    for kind in ("hacked", "reward"):
        names = {f"{kind}_<score>" if name.removeprefix(f"{kind}_") in scores - {name} else name for name in names}
    return names
