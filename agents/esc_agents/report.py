"""Results for people: the table that a run and an evaluation end with."""

from __future__ import annotations

from math import isinf

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from esc_agents.evaluate import Summary

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
    table = Table(title=title, title_justify="left", title_style="bold", header_style="bold")
    for column in COLUMNS:
        justify = "left" if column == "policy" else "right"
        table.add_column(column, justify=justify, no_wrap=True)
    for name, summary in results.items():
        table.add_row(*map(escape, cells(name, summary)))  # brackets are markup to rich
    return table


def markdown(results: dict[str, Summary]) -> str:
    """One row per policy, as a Markdown table."""
    rows = [COLUMNS, ["---", *["---:"] * (len(COLUMNS) - 1)]]
    rows += [cells(name, summary) for name, summary in results.items()]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def show(table: Table) -> None:
    """Print to standard output, never narrower than the table needs."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=140)
    console.print(table)
