"""Rows of the table of docs/results/from_clips.md; what they are about stands in pages.yaml."""

from statistics import mean

from benchmarks.environments.roboscape import success_of
from benchmarks.tables.roboscape import DOMAINS
from benchmarks.tables.table import Rows, percent, points, read

FILE, PLANNED = "policy_rl_from_clips.json", ("planned demonstrations", 4)


def clones() -> Rows:
    rows = read(FILE)["rows"]
    usual = {one["seed"]: one["success_after"] for one in rows if (one["start"], one["demonstrations"]) == PLANNED}
    for start, episodes in dict.fromkeys((one["start"], one["demonstrations"]) for one in rows):
        of = [one for one in rows if (one["start"], one["demonstrations"]) == (start, episodes)]
        trained = [one for one in of if "success_after" in one]
        clone = [mean(one["success_before"]) for one in of]
        after = [mean(one["success_after"]) for one in trained]
        pairs = [(usual[one["seed"]], one["success_after"]) for one in trained if (start, episodes) != PLANNED]
        first, last = ([x for pair in pairs for x in pair[i]] for i in (0, 1))
        yield (
            start, episodes, ", ".join(str(one["seed"]) for one in of), ", ".join(map(percent, clone)),
            percent(mean(clone)), ", ".join(map(percent, after)), points(first, last) if pairs else "",
        )


def scenes() -> Rows:
    """In the procedural scenes; after RL where there was any."""
    rows = read("policy_rl_from_clips_scenes.json")["rows"]
    for start in dict.fromkeys(row["start"] for row in rows):
        of = {row["model"]: row for row in rows if row["start"] == start}
        yield (
            start, of["sft"]["config"]["sft"]["num_demonstrations"],
            *(f"{success_of(of[training], domain):.1f}" if training in of else ""
              for training in ("sft", "world_model") for domain in DOMAINS),
        )
