"""Tables, as rows of text of which the first is the header: for the terminal, as Markdown."""

from __future__ import annotations

import re
from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

_BOLD = re.compile(r"\*\*(.*)\*\*")


def terminal(rows: Sequence[Sequence[str]], title: str = "") -> Table:
    """The header, then the rows, for the terminal; **bold** as in Markdown."""
    table = Table(
        title=escape(title), title_justify="left", title_style="bold", header_style="bold"
    )
    header, *body = rows
    for index, column in enumerate(header):
        table.add_column(column, justify="right" if index else "left")
    for row in body:  # brackets are markup to rich
        table.add_row(*(_BOLD.sub(r"[bold]\1[/]", escape(cell)) for cell in row))
    return table


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """The header, then the rows, as a Markdown table; all but the first column are numbers."""
    header, *body = rows
    rule = ["---", *["---:"] * (len(header) - 1)]
    return "\n".join(f"| {' | '.join(row)} |" for row in [header, rule, *body])


def show(table: Table) -> None:
    """Print to standard output; where that is no terminal, as wide as the table needs."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=Console(width=10_000).measure(table).maximum)
    console.print(table)
