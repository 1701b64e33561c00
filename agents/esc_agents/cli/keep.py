"""A finished run becomes an agent that comes with the package.

python -m esc_agents.cli.keep runs/RUN --name highway-dense
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro import conf

from esc_agents.cli import guarded, parse
from esc_agents.errors import say

PROGRAM = "keep"


@dataclass(frozen=True)
class KeepArguments:
    """Copy a finished run into the zoo, without what only training needs."""

    run: Annotated[Path, conf.Positional]
    """Directory that esc-train wrote."""
    name: str
    """What it is called there: its scenario."""


def main() -> None:
    """Entry point of ``python -m esc_agents.cli.keep``."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: done."""
    arguments = parse(PROGRAM, KeepArguments, args)
    from esc_agents.zoo.keeping import keep

    say(f"{arguments.run} is now {keep(arguments.run, arguments.name)}")
    return 0


if __name__ == "__main__":
    main()
