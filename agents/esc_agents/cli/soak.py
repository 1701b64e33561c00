"""Every scenario for a long time, with random actions: what must never happen, counted.

python -m esc_agents.cli.soak --steps 1000000 --out docs/reliability.md        (make soak)
"""

from __future__ import annotations

import sys
from pathlib import Path

from pydantic import BaseModel, ConfigDict, PositiveInt

from esc_agents.cli import guarded, parse
from esc_agents.config import Seed

PROGRAM = "soak"


class SoakArguments(BaseModel):
    """Step every scenario with random actions and count what goes wrong."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    steps: PositiveInt = 1_000_000
    """Over all scenarios, with the actions of PPO and of SAC."""
    seed: Seed = 0
    out: Path = Path("docs/reliability.md")
    """Markdown file to write."""


def main() -> None:
    """Entry point of ``python -m esc_agents.cli.soak``."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: no fault."""
    arguments = parse(PROGRAM, SoakArguments, args)
    from esc_agents.proof.soak import soak_all

    found = soak_all(arguments.steps, arguments.seed, arguments.out)
    return 1 if any(result.faults for result in found) else 0


if __name__ == "__main__":
    main()
