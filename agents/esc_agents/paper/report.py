"""The table: our errors beside the paper's, and what ESC saves."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
from rich.table import Table

from esc_agents.errors import UserError
from esc_agents.paper.results import Damaged, Result, read_file
from esc_agents.report import show
from esc_agents.run import write_text
from esc_agents.train import say

Key = tuple[int, int, str, str]
"""(benchmark, M of the test sets, representation, "fixed" or "any" M in training)."""

CSV_COLUMNS = (
    "benchmark", "vehicles", "repr", "trained", "mse", "mse_std", "rmse", "seeds", "paper_mse",
    "paper_std",
)  # fmt: skip
NOTE = """\
Mean squared errors on 2048 test sets after training, mean ± one standard deviation over seeds; the
best of a row, ours and the paper's apart, in bold. The paper calls its numbers RMSE, but they are
mean squared errors: as roots, those of FP and AP at M = 20 in benchmarks 1 and 6 would be worse
than predicting the mean. Square roots of ours are in `table.csv`.
"""


@dataclass(frozen=True)
class Entry:
    """An error of the table. seeds: trainings behind it, 0 where the paper does not say."""

    mean: float
    std: float
    seeds: int = 0

    def __str__(self) -> str:
        return f"{self.mean:.3g}" + (f" ± {self.std:.2g}" if self.seeds != 1 else "")


@cache
def published() -> Mapping[Key, Entry]:
    """The paper's table."""
    text = (files("esc_agents.paper") / "published.csv").read_text(encoding="utf-8")
    return {
        (int(row["benchmark"]), int(row["vehicles"]), row["repr"], row["trained"]): Entry(
            float(row["mean"]), float(row["std"])
        )
        for row in csv.DictReader(io.StringIO(text))
    }


def load(out: Path) -> list[Result]:
    """All whole results in a directory; damaged files are named and left out."""
    found = []
    for path in sorted(out.glob("b*.json")):
        try:
            found.append(read_file(path))
        except Damaged as damaged:
            say(f"{damaged}; it is left out, and esc-paper run trains it again")
    if not found:
        raise UserError(f"--out {out}: expected results of esc-paper run in it, found none")
    return found


def entries(results: Sequence[Result]) -> dict[Key, Entry]:
    """Mean and standard deviation over seeds of the last errors."""
    errors: dict[Key, list[float]] = {}
    for result in results:
        cell, trained = result.cell, "any" if result.cell.size is None else "fixed"
        for size, error in result.points[-1].errors.items():
            errors.setdefault((cell.benchmark, size, cell.repr, trained), []).append(error)
    return {
        key: Entry(float(np.mean(found)), float(np.std(found, ddof=len(found) > 1)), len(found))
        for key, found in errors.items()
    }


def reduction(table: Mapping[Key, Entry], ours: tuple[str, str], other: tuple[str, str]) -> float:
    """Mean of 1 - ours/other over the cells that have both, as the paper averages; NaN if none."""
    ratios = [
        1 - entry.mean / table[benchmark, size, *other].mean
        for (benchmark, size, *column), entry in table.items()
        if tuple(column) == ours and (benchmark, size, *other) in table
    ]
    return float(np.mean(ratios)) if ratios else float("nan")


def columns_of(table: Mapping[Key, Entry]) -> list[tuple[str, str]]:
    """(representation, trained) of the table's columns, the paper's ones first."""
    first = dict.fromkeys((repr, trained) for _, _, repr, trained in published())
    return [*first, *sorted({key[2:] for key in table} - set(first))]


def rows(table: Mapping[Key, Entry]) -> Iterator[list[str]]:
    """The table as text: a header, then a row for each benchmark and size."""
    columns = [column for column in columns_of(table) if any(k[2:] == column for k in table)]
    titles = [f"{repr} (M {'in 1..20' if t == 'any' else 'fixed'})" for repr, t in columns]
    yield ["benchmark", "M", *titles, *(f"paper: {title}" for title in titles)]
    for benchmark, size in sorted({key[:2] for key in table}):
        both = [
            [source.get((benchmark, size, *column)) for column in columns]
            for source in (table, published())
        ]
        yield [str(benchmark), str(size), *(cell for side in both for cell in _best_in_bold(side))]


def _best_in_bold(side: Sequence[Entry | None]) -> list[str]:
    least = min((entry.mean for entry in side if entry), default=None)
    return [
        "" if entry is None else f"**{entry}**" if entry.mean == least else str(entry)
        for entry in side
    ]


def savings(table: Mapping[Key, Entry]) -> list[list[str]]:
    """Mean reductions of the error, ours and the paper's, over the rows that we have."""
    pairs = [
        ("ESC (fixed M) against FP", ("esc", "fixed"), ("fp", "fixed")),
        ("ESC (fixed M) against AP", ("esc", "fixed"), ("ap", "fixed")),
        ("FP against AP", ("fp", "fixed"), ("ap", "fixed")),
        ("ESC (M in 1..20) against FP", ("esc", "any"), ("fp", "fixed")),
    ]
    present = {key[:2] for key in table}
    paper = {key: entry for key, entry in published().items() if key[:2] in present}
    found = [["mean reduction of the error", "ours", "paper"]]
    for title, ours, other in pairs:
        sides = [reduction(source, ours, other) for source in (table, paper)]
        found.append([title, *("" if np.isnan(side) else f"{side:.1%}" for side in sides)])
    return found


def report(out: Path) -> None:
    """Print the table of the results in ``out``; write table.md and table.csv there."""
    results = load(out)
    table = entries(results)
    tables = list(rows(table)), savings(table)
    for content in tables:
        show(_terminal(content))
    made_with = sorted({", ".join(f"{k} {v}" for k, v in r.made_with.items()) for r in results})
    updates = sorted({result.updates for result in results})
    text = [
        "# The paper's experiment\n", NOTE, _markdown(tables[0]), "", _markdown(tables[1]), "",
        f"Updates: {', '.join(map(str, updates))}; seeds: {_seeds(table)}. Made with",
        *(f"- {line}" for line in made_with),
    ]  # fmt: skip
    write_text(out / "table.md", "\n".join(text) + "\n")
    write_text(out / "table.csv", _csv(table))
    say(f"Written: {out / 'table.md'}, {out / 'table.csv'}")


def _seeds(table: Mapping[Key, Entry]) -> str:
    counts = sorted({entry.seeds for entry in table.values()})
    return f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"


def _csv(table: Mapping[Key, Entry]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for key in sorted(table):
        ours, theirs = table[key], published().get(key)
        paper = (theirs.mean, theirs.std) if theirs else ("", "")
        writer.writerow([*key, ours.mean, ours.std, ours.mean**0.5, ours.seeds, *paper])
    return text.getvalue()


def _markdown(content: Sequence[Sequence[str]]) -> str:
    header, *body = content
    rule = ["---", *["---:"] * (len(header) - 1)]
    return "\n".join(f"| {' | '.join(row)} |" for row in [header, rule, *body])


def _terminal(content: Sequence[Sequence[str]]) -> Table:
    table = Table(header_style="bold")
    for index, name in enumerate(content[0]):
        table.add_column(name, justify="right" if index else "left")
    for row in content[1:]:
        table.add_row(*(cell.replace("**", "") for cell in row))
    return table
