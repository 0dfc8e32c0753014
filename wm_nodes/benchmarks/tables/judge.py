"""Rows of the tables of docs/results/judge.md; what they are about stands in pages.yaml."""

from benchmarks.tables.table import Rows, percent, read, share


def hacked() -> Rows:
    both = [read(f"judge_hack{of}.json")["counts"] for of in ("", "_scenes")]
    for pattern in ("occlusion", "motion", "background", "physics", "benign"):
        steps = (1, 2, 3, 4) if pattern == "benign" else (3, 4)
        for edit in ("all", *sorted({one["edit"] for one in both[0] if one["pattern"] == pattern})):
            cells: list[object] = []
            for counts in both:
                of = [one for one in counts if one["pattern"] == pattern and edit in ("all", one["edit"])]
                of = [one for one in of if one["step"] in steps]
                paid, silent = (round(sum(one["n"] * one[key] for one in of)) for key in ("share", "silent"))
                n = sum(one["n"] for one in of)
                cells += [n, share(paid, n), percent(silent / n)]
            yield pattern, edit.replace("_", " "), *cells


def checked() -> Rows:
    found = read("judge_check.json")
    for name, parts in found["paid"].items():
        yield name, "{count} of {of}".format(**parts["policy"])
    yield "clean and benign together", "{count} of {of}".format(**found["kept"])
    yield "faults together", "{count} of {of}".format(**found["paid_faults"])


def erring() -> Rows:
    for one in read("judge_erring.json")["ways"]:
        found = one["difference"] or one
        signed = "{:+.1f}" if one["difference"] else "{:.1f}"
        numbers = (found[key] for key in ("accuracy", "faults_accepted", "successes_kept"))
        cells = (f"{signed} ({signed} to {signed})".format(*(100 * value for value in number)) for number in numbers)
        errors = "honest" if one["honest"] else "overconfident"
        yield one["rate"], one["shared"], errors, one["way"], *cells, signed.format(found["calls"][0])


def audits() -> Rows:
    for one in read("judge_erring.json")["audits"]:
        shares = (percent(one[key][0]) for key in ("mended", "spoiled", "hacks", "false_hacks"))
        errors = "honest" if one["honest"] else "overconfident"
        yield one["rate"], one["shared"], errors, one["audit"], *shares, f"{one['calls'][0]:.1f}"
