"""JSON results of earlier versions in the form of today, which is shorter; no value changes.

python -m esc_agents.cli.rewrite docs
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro import conf

from esc_agents.cli import guarded, parse
from esc_agents.errors import UserError, say
from esc_agents.reporting.records import Damaged, rewrite

PROGRAM = "rewrite"


@dataclass(frozen=True)
class RewriteArguments:
    """Write the JSON files of folders anew, arrays of numbers on one line."""

    folders: Annotated[tuple[Path, ...], conf.Positional, conf.arg(metavar="DIR ...")]
    """Looked through with all that is in them."""


def main() -> None:
    """Entry point of ``python -m esc_agents.cli.rewrite``."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: done."""
    folders = parse(PROGRAM, RewriteArguments, args).folders
    if missing := [folder for folder in folders if not folder.is_dir()]:
        raise UserError(f"{missing[0]} is no folder")
    paths = [path for folder in folders for path in sorted(folder.rglob("*.json"))]
    try:
        changed = sum(map(rewrite, paths))
    except Damaged as damaged:
        raise UserError(str(damaged)) from damaged
    say(f"{changed} of {len(paths)} files written anew")
    return 0


if __name__ == "__main__":
    main()
