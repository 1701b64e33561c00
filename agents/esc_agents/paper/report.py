"""The report: our table beside the paper's, curves, bars, and what the studies show."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from esc_agents import files
from esc_agents.errors import UserError, say
from esc_agents.paper import figures
from esc_agents.paper.cells import CODE_DIM, INIT, overtaking
from esc_agents.paper.results import Result, read_file
from esc_agents.paper.side_by_side import (
    Table,
    as_csv,
    columns_of,
    entries,
    published,
    roots,
    rows,
    savings,
    title_of,
)
from esc_agents.paper.targets import MAX_VEHICLES
from esc_agents.reporting.documents import Block, Heading, Rows, Text, picture, write
from esc_agents.reporting.records import Damaged
from esc_agents.reporting.tables import show, terminal

TITLE = "The paper's experiment, ours beside the paper's"
NOTE = """\
Mean squared errors on 2048 test sets after training, mean ± one standard deviation over seeds \
(ours without ±: one seed); \
the best of a row, ours and the paper's apart, in bold. "Any M" was trained on sets of 1 to 20 \
vehicles, the others on sets of the row's size. Weights start uniform in Glorot's bounds, biases \
at 0: the paper does not say how, and its first author's code of that time (DSAC, 2020) does so."""
OTHER = "With the initialisation of torch"
OTHER_INIT = """\
Everything else is the same, but weights start as torch starts linear layers: uniform within one \
over the root of the number of inputs, biases too."""
WHY_MSE = """\
The paper calls its numbers root mean squared errors. They are mean squared errors: as roots, \
those of FP and AP at M = 20 in benchmarks 1 and 6 would be worse than predicting the mean. So \
mean squared errors are compared above; these are the roots of both:"""


_DEVIATION = re.compile(r"±[^*]*")


def load(folder: Path, trust: bool = False) -> list[Result]:
    """All results in a directory. Raises UserError where there are none, or names the damaged."""
    found, damaged = [], []
    for path in sorted(folder.glob("b*.json")):
        try:
            found.append(read_file(path, trust))
        except Damaged as error:
            damaged.append(str(error))
    if damaged:
        raise UserError(f"{'; '.join(damaged)}; esc-paper run trains it again, then report")
    if not found:
        raise UserError(f"expected results of esc-paper run in {folder}, found none")
    return found


def report(out: Path, trust: bool = False) -> None:
    """Print the table of the cells in ``out``; write the report and its pictures there."""
    results = load(out / "cells", trust)
    ours = [r for r in results if r.cell.init == INIT]
    table, other = entries(ours), entries([r for r in results if r.cell.init != INIT])
    blocks = [*summary(ours, table), *studies(ours), *other_init(other), *provenance(results)]
    for title, numbers in (("", table), (OTHER, other)):
        for content in (list(rows(numbers, published())), savings(numbers)):
            if len(content) > 1:
                # Without the deviations, for which there is no room.
                plain = [[_DEVIATION.sub("", cell) for cell in row] for row in content]
                show(terminal(plain, title))
    written = write(out, "report", TITLE, blocks)
    files.write_text(out / "table.csv", as_csv(results))
    say(f"Written into {out}: {', '.join(path.name for path in written)}, table.csv")


def summary(results: Sequence[Result], table: Table) -> Iterator[Block]:
    """The table, what ESC saves, bars and curves."""
    if not table:
        return
    yield Text(NOTE)
    yield from _beside_the_paper(table)
    if missing := len(published().keys() - table.keys()):
        yield Text(
            f"{missing} of the paper's {len(published())} entries are not there yet: `esc-paper "
            "run` trains what is missing."
        )
    yield Text(WHY_MSE)
    yield Rows(list(rows(entries(results, 0.5), roots(published()))))
    yield Heading("Final errors")
    names = ", ".join(title_of(column) for column in columns_of(table))
    yield picture("bars", figures.bars(table), f"Final errors of {names}, by benchmark and M")
    yield Heading("Training curves")
    yield Text("Mean squared error on the test sets; bands are 95 % intervals over seeds.")
    for benchmark in sorted({key[0] for key in table}):
        alt = f"Benchmark {benchmark}: error over updates of {names}"
        yield picture(f"curves-{benchmark}", figures.curves(results, benchmark), alt)


def _beside_the_paper(table: Table) -> Iterator[Block]:
    yield Rows(list(rows(table, published())))
    if len(saved := savings(table)) > 1:
        yield Rows(saved)


def studies(results: Sequence[Result]) -> Iterator[Block]:
    """What there are cells of: d3, truncation, two vehicles that change places."""
    for benchmark in sorted({r.cell.benchmark for r in results}):
        found = [r for r in results if r.cell.benchmark == benchmark]
        yield from _places(benchmark, [r for r in found if r.overtaking])
        yield from _truncation(benchmark, found)
        yield from _code_dims(benchmark, found)


def _places(benchmark: int, found: Sequence[Result]) -> Iterator[Block]:
    if not found:
        return
    j, _ = overtaking()
    yield Heading(f"Two vehicles change places (benchmark {benchmark})")
    jumps = []
    for name in dict.fromkeys(r.cell.repr for r in found):
        steps = [
            np.abs(np.diff(np.array(r.overtaking))).max() for r in found if r.cell.repr == name
        ]
        jumps.append(f"{np.mean(steps):.2g} ({title_of((name, 'fixed'))})")
    yield Text(
        "The paper's example: {[j, 2], [1, 5]}, all other features 0. FP sorts by the first "
        "feature, so at j = 1 its two inputs change places. Policies trained on two vehicles; the "
        f"largest change of the output while j grows by {j[1] - j[0]:.2f}: {', '.join(jumps)}."
    )
    figure = figures.change_of_places(found)
    yield picture(f"places-{benchmark}", figure, "Outputs over j: FP jumps at j = 1, ESC does not")


def _truncation(benchmark: int, found: Sequence[Result]) -> Iterator[Block]:
    if not any(r.cell.slots for r in found):
        return
    yield Heading(f"More vehicles than places (benchmark {benchmark})")
    yield Text(
        f"Of M = {MAX_VEHICLES} vehicles FP takes the Z nearest by the first two features. The "
        "target depends on all of them: what is cut off is lost, whatever is trained."
    )
    chosen = [
        r for r in found
        if r.cell.size == MAX_VEHICLES and r.cell.repr in ("fp", "esc")
        and r.cell.code_dim == CODE_DIM
    ]  # fmt: skip
    alt = "Error of FP over Z, beside that of ESC"
    yield picture(f"truncation-{benchmark}", figures.truncation(chosen), alt)


def _code_dims(benchmark: int, found: Sequence[Result]) -> Iterator[Block]:
    if all(r.cell.code_dim == CODE_DIM for r in found):
        return
    chosen = [r for r in found if r.cell.size is None and r.cell.repr == "esc"]
    yield Heading(f"How large the code has to be (benchmark {benchmark})")
    yield Text(
        "ESC trained on sets of 1 to 20 vehicles, with codes below, at and above the "
        "N·d1 + 1 numbers from which on Theorem 1 promises that no two sets share a code."
    )
    best = {d: np.mean([list(r.points[-1].errors.values()) for r in chosen
                        if r.cell.code_dim == d])
            for d in sorted({r.cell.code_dim for r in chosen})}  # fmt: skip
    yield Rows([["d3", "mean squared error over M = 5, 10, 15, 20"],
                *([str(d), f"{error:.3g}"] for d, error in best.items())])  # fmt: skip
    yield picture(f"code-dim-{benchmark}", figures.code_dims(chosen), "Error of ESC over d3")


def other_init(table: Table) -> Iterator[Block]:
    """The table once more, with weights that start in the other way."""
    if not table:
        return
    yield Heading(OTHER)
    yield Text(OTHER_INIT)
    yield from _beside_the_paper(table)


def provenance(results: Sequence[Result]) -> Iterator[Block]:
    """What the numbers were made with."""
    yield Heading("How this was made")
    updates = ", ".join(str(n) for n in sorted({r.updates for r in results}))
    seeds = ", ".join(str(n) for n in sorted({r.cell.seed for r in results}))
    hours = sum(r.seconds for r in results) / 3600
    yield Text(
        f"`esc-paper run` and `esc-paper report`: {len(results)} trainings of {updates} updates, "
        f"seeds {seeds}, {hours:.1f} hours of training in all. Every training is a file in "
        "`cells`; the numbers are in [table.csv](table.csv). Made with:"
    )
    made_with = {", ".join(f"{k} {v}" for k, v in r.made_with.items()) for r in results}
    yield Text("\n".join(sorted(made_with)), bullets=True)
