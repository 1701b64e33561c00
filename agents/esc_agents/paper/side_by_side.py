"""The paper's table, ours beside it: errors by benchmark, size of the sets and representation."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import get_args

import numpy as np

from esc_agents.paper.cells import CODE_DIM, Cell, Init
from esc_agents.paper.results import Result

Column = tuple[str, str]
"""(representation, "fixed" or "any" M in training)."""
Key = tuple[int, int, str, str]
"""(benchmark, M of the test sets, *column)."""
Table = Mapping[Key, "Entry"]

CSV_COLUMNS = (
    "init", "benchmark", "vehicles", "repr", "trained", "mse", "mse_std", "rmse", "rmse_std",
    "seeds", "paper_mse", "paper_std",
)  # fmt: skip


@dataclass(frozen=True)
class Entry:
    """An error of the table. seeds: trainings behind it, 0 where the paper does not say."""

    mean: float
    std: float
    seeds: int = 0

    def __str__(self) -> str:
        return f"{self.mean:.3g}" + (f"±{self.std:.2g}" if self.seeds != 1 else "")


@cache
def published() -> Table:
    """The paper's table."""
    text = (files("esc_agents.paper") / "published.csv").read_text(encoding="utf-8")
    return {
        (int(row["benchmark"]), int(row["vehicles"]), row["repr"], row["trained"]): Entry(
            float(row["mean"]), float(row["std"])
        )
        for row in csv.DictReader(io.StringIO(text))
    }


def column_of(cell: Cell) -> Column:
    """The column of the table that a cell is in."""
    return cell.repr, "any" if cell.size is None else "fixed"


def title_of(column: Column) -> str:
    """How a column is called."""
    repr, trained = column
    name = repr.upper() if len(repr) < 4 and repr != "max" else repr
    return name + (", any M" if trained == "any" else "")


def of_the_table(results: Sequence[Result]) -> list[Result]:
    """Those cells that are in no study of d3, Z or two vehicles that change places."""
    return [
        r for r in results
        if (r.cell.code_dim, r.cell.slots, r.overtaking) == (CODE_DIM, None, None)
    ]  # fmt: skip


def entries(results: Sequence[Result], power: float = 1.0) -> dict[Key, Entry]:
    """Mean and standard deviation over seeds of the last errors, each to ``power``."""
    errors: dict[Key, list[float]] = {}
    for result in of_the_table(results):
        cell = result.cell
        for size, error in result.points[-1].errors.items():
            errors.setdefault((cell.benchmark, size, *column_of(cell)), []).append(error**power)
    return {
        key: Entry(float(np.mean(found)), float(np.std(found, ddof=len(found) > 1)), len(found))
        for key, found in errors.items()
    }


def roots(table: Table) -> dict[Key, Entry]:
    """The square roots of means, without deviations."""
    return {key: Entry(entry.mean**0.5, 0.0, 1) for key, entry in table.items()}


def columns_of(table: Table) -> list[Column]:
    """The table's columns, the paper's ones first."""
    present = {key[2:] for key in table}
    first = [c for c in dict.fromkeys(key[2:] for key in published()) if c in present]
    return [*first, *sorted(present - set(first))]


def rows(table: Table, paper: Table) -> Iterator[list[str]]:
    """The table as text: a header, then a row for each benchmark and size."""
    columns = columns_of(table)
    theirs = [column for column in columns if column in columns_of(paper)]
    yield ["benchmark", "M", *map(title_of, columns), *(f"paper: {title_of(c)}" for c in theirs)]
    for benchmark, size in sorted({key[:2] for key in table}):
        ours = [table.get((benchmark, size, *column)) for column in columns]
        other = [paper.get((benchmark, size, *column)) for column in theirs]
        yield [str(benchmark), str(size), *_best_in_bold(ours), *_best_in_bold(other)]


def _best_in_bold(side: Sequence[Entry | None]) -> list[str]:
    least = min((entry.mean for entry in side if entry), default=None)
    return [
        "" if entry is None else f"**{entry}**" if entry.mean == least else str(entry)
        for entry in side
    ]


def ratios(table: Table, ours: Column, other: Column) -> dict[tuple[int, int], float]:
    """ours/other for each (benchmark, M) of the paper's table that has both."""
    return {
        (benchmark, size): entry.mean / table[benchmark, size, *other].mean
        for (benchmark, size, *column), entry in table.items()
        if tuple(column) == ours
        and (benchmark, size, *other) in table
        and (benchmark, size, *ours) in published()
    }


def savings(table: Table) -> list[list[str]]:
    """Mean reductions of the error, as the paper averages: 1 - ours/other, mean over the cells.

    Beside them the paper's over the same cells, in how many of these ours is below the other, and
    where it is not.
    """
    esc, any_esc, fp, ap = ("esc", "fixed"), ("esc", "any"), ("fp", "fixed"), ("ap", "fixed")
    found = [["mean reduction of the error", "ours", "paper", "lower in", "not in"]]
    for ours, other in ((esc, fp), (esc, ap), (fp, ap), (any_esc, fp)):
        if here := ratios(table, ours, other):
            paper = ratios(published(), ours, other)
            higher = [row for row, ratio in sorted(here.items()) if ratio >= 1]
            lower = f"{len(here) - len(higher)} of {len(here)}"
            where = "; ".join(
                f"benchmark {benchmark}, M={size}: {table[benchmark, size, *ours].mean:.3g} "
                f"against {table[benchmark, size, *other].mean:.3g}"
                for benchmark, size in higher
            )
            name = f"{title_of(ours)} against {title_of(other)}"
            saved = [1 - np.mean([side[row] for row in here]) for side in (here, paper)]
            found.append([name, *(f"{share:.1%}" for share in saved), lower, where])
    return found


def as_csv(results: Sequence[Result]) -> str:
    """One line for each entry, numbers unrounded."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for init in get_args(Init):
        made = [r for r in results if r.cell.init == init]
        table, rooted = entries(made), entries(made, 0.5)
        for key in sorted(table):
            ours, root, theirs = table[key], rooted[key], published().get(key)
            numbers = [ours.mean, ours.std, root.mean, root.std, ours.seeds]
            paper = (theirs.mean, theirs.std) if theirs else ("", "")
            writer.writerow([init, *key, *numbers, *paper])
    return text.getvalue()
