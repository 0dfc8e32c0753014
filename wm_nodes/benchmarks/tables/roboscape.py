"""Rows of the tables of docs/results/roboscape.md; what they are about stands in pages.yaml."""

from benchmarks.tables.table import Rows, read
from wm_nodes.config.scenes import splits

REWARDS = "roboscape_rewards.json"


def rewards() -> Rows:
    found = read(REWARDS)["rows"]
    for task, reward in dict.fromkeys((one["task"], one["reward"]) for one in found):
        of = {one["domain"]: one for one in found if (one["task"], one["reward"]) == (task, reward)}
        yield (
            task, reward, *("{:.2f} [{:.2f}, {:.2f}]".format(*of[domain]["auroc"]) for domain in splits()),
            *("/".join(form.format(of[domain][name]) for domain in splits())
              for name, form in (("auroc_empty_hand", "{:.2f}"), ("rank_correlation", "{:+.2f}"))),
        )
