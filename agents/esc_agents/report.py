"""Results for people: the table that a run and an evaluation end with."""

from __future__ import annotations

import re
from collections.abc import Sequence
from math import isinf

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from esc_agents.evaluate import Summary

_BOLD = re.compile(r"\*\*(.*)\*\*")
COLUMNS = ("policy", "return", "collisions", "speed m/s", "steps", "lane changes", "min TTC s")


def cells(name: str, s: Summary) -> list[str]:
    """The row of a policy; brackets hold 95 % intervals."""
    return [
        name,
        f"{s.reward:.2f} [{s.reward_low:.2f}, {s.reward_high:.2f}]",
        f"{s.collision_rate:.0%} [{s.collision_low:.0%}, {s.collision_high:.0%}]",
        f"{s.speed:.1f}",
        f"{s.length:.1f}",
        f"{s.lane_changes:.1f}",
        "none" if isinf(s.min_ttc) else f"{s.min_ttc:.1f}",
    ]


def results_table(title: str, results: dict[str, Summary]) -> Table:
    """One row per policy, for the terminal."""
    return terminal([COLUMNS, *(cells(name, s) for name, s in results.items())], title)


def terminal(rows: Sequence[Sequence[str]], title: str = "") -> Table:
    """The header, then the rows, for the terminal; **bold** as in Markdown."""
    table = Table(title=title, title_justify="left", title_style="bold", header_style="bold")
    header, *body = rows
    for index, column in enumerate(header):
        table.add_column(column, justify="right" if index else "left")
    for row in body:  # brackets are markup to rich
        table.add_row(*(_BOLD.sub(r"[bold]\1[/]", escape(cell)) for cell in row))
    return table


def markdown(results: dict[str, Summary]) -> str:
    """One row per policy, as a Markdown table."""
    rows = [COLUMNS, ["---", *["---:"] * (len(COLUMNS) - 1)]]
    rows += [cells(name, summary) for name, summary in results.items()]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def show(table: Table) -> None:
    """Print to standard output; where that is no terminal, as wide as the table needs."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=Console(width=10_000).measure(table).maximum)
    console.print(table)
