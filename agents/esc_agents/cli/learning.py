"""Finished runs of one scenario, seed by seed, beside the policies that never look.

python -m esc_agents.cli.learning --runs runs/a runs/b runs/c --out docs/learning.md
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro import conf

from esc_agents.cli import Trust, guarded, parse

PROGRAM = "learning"


@dataclass(frozen=True)
class LearningArguments:
    """Report what finished runs of one scenario, one per seed, have learned."""

    runs: Annotated[tuple[Path, ...], conf.arg(metavar="DIR ...")]
    """Run directories of esc-train."""
    out: Path = Path("docs/learning.md")
    """Markdown file to write; a figure (.png) and the metrics (.csv) go beside it."""
    trust: Trust = False


def main() -> None:
    """Entry point of ``python -m esc_agents.cli.learning``."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: done."""
    arguments = parse(PROGRAM, LearningArguments, args)
    from esc_agents.proof.learning import write_report

    write_report(arguments.runs, arguments.out, arguments.trust)
    return 0


if __name__ == "__main__":
    main()
