"""Trained agents that come with the package: out of a comparison, or a single run.

esc-compare --config zoo --out runs/zoo
python -m esc_agents.cli.keep runs/zoo
python -m esc_agents.cli.keep runs/RUN --name highway-dense
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro import conf

from esc_agents.cli import guarded, parse
from esc_agents.errors import UserError, say

PROGRAM = "keep"


@dataclass(frozen=True)
class KeepArguments:
    """Copy what drives into the zoo, without what only training needs."""

    run: Annotated[Path, conf.Positional]
    """Directory of esc-compare, whose best agents are kept and reported; or of esc-train."""
    name: str | None = None
    """Of a single run: what it is called there, its scenario."""
    docs: Path = Path("docs")
    """Of a comparison: folder of zoo.md and its films."""


def main() -> None:
    """Entry point of ``python -m esc_agents.cli.keep``."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: done."""
    arguments = parse(PROGRAM, KeepArguments, args)
    from esc_agents.compare import store
    from esc_agents.zoo.keeping import keep
    from esc_agents.zoo.report import publish

    if arguments.name is None and not arguments.run.is_dir():
        raise UserError(f"{arguments.run}: expected a directory of esc-compare or esc-train")
    comparison = any(store.task_folders(arguments.run))
    if comparison != (arguments.name is None):
        raise UserError("expected the directory of a comparison, or that of a run and --name NAME")
    if arguments.name is None:
        publish(arguments.run, arguments.docs)
    else:
        say(f"{arguments.run} is now {keep(arguments.run, arguments.name)}")
    return 0


if __name__ == "__main__":
    main()
