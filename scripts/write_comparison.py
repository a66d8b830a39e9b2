"""Writes the tables of errors in docs/comparison.md.

    python scripts/write_comparison.py

The published errors come from docs/published_errors.csv, which states the source of each error. Our errors
are the means of the files results.csv in docs/results/accuracy, each with the commit that its provenance.json
states. The script replaces the text between the comments `<!-- published errors -->` or `<!-- our errors -->`
and the next `<!-- end -->`.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
from common import write_text

from jaxsmw.benchmark.tables import markdown

DOCS = Path(__file__).parents[1] / "docs"

# For each column of our errors: the directory of the results and the beginning of the names of the sources.
OURS = {
    "FAUST": ("faust_r", ""),
    "TOSCA": ("tosca_r", ""),
    "non-isometric TOSCA": ("nonisometric", ""),
    "SMAL, 60 pairs": ("smal_r", ""),
    "SMAL, 300 pairs": ("smal_300", ""),
    "SHREC'19": ("shrec19_r", ""),
    "SHREC'16 topology": ("topology", ""),
    "SHREC'16 cuts": ("partial", "cuts_"),
    "SHREC'16 holes": ("partial", "holes_"),
}


def rows_of(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def published_errors() -> str:
    """Return the table of published errors, followed by the doubts about single errors."""
    rows = rows_of(DOCS / "published_errors.csv")
    data = list(dict.fromkeys(row["data"] for row in rows))
    methods = dict.fromkeys((row["method"], row["trained"]) for row in rows)
    errors = {(row["method"], row["data"]): row for row in rows}
    table, doubts = [["method", "trained", *data]], []
    for method, trained in methods:
        cells = []
        for column in data:
            row = errors.get((method, column))
            if row is None:
                cells.append("–")
                continue
            cells.append(row["error"] + (" (doubtful)" if row["doubt"] else ""))
            if row["doubt"]:
                doubts.append(f"The error {row['error']} of {method} on {column} is doubtful. {row['doubt']}")
        table.append([method, trained, *cells])
    return "\n\n".join([markdown(table).strip(), *doubts])


def our_errors() -> str:
    """Return the table of our errors, in thousandths of the square root of the target's area."""
    table = [["", *OURS], ["pairs"], ["`paper` (MWP)"], ["`accurate`"], ["commit"]]
    for directory, beginning in OURS.values():
        place = DOCS / "results" / "accuracy" / directory
        rows = [row for row in rows_of(place / "results.csv") if row["source"].startswith(beginning)]
        table[1].append(str(len({(row["source"], row["target"]) for row in rows})))
        for cells, method in ((table[2], "mwp"), (table[3], "accurate")):
            errors = [1000 * float(row["mean"]) for row in rows if row["method"] == method]
            cells.append(f"{np.mean(errors):.1f}" if errors else "–")
        noted = json.loads((place / "provenance.json").read_text("utf-8"))["noted"]
        table[4].append(noted["commit"][:7])
    return markdown(table)


def replaced(text: str, name: str, table: str) -> str:
    """Return a text in which the table between two comments is replaced."""
    before, start, rest = text.partition(f"<!-- {name} -->\n")
    _, end, after = rest.partition("<!-- end -->")
    if not start or not end:
        raise SystemExit(f"docs/comparison.md has no comments <!-- {name} --> and <!-- end -->: add them.")
    return f"{before}{start}\n{table.strip()}\n\n{end}{after}"


def written(text: str) -> str:
    """Return the text of docs/comparison.md with the present tables."""
    return replaced(replaced(text, "published errors", published_errors()), "our errors", our_errors())


def main() -> None:
    page = DOCS / "comparison.md"
    write_text(page, written(page.read_text("utf-8")))


if __name__ == "__main__":
    main()
