"""The fault drill: real training processes, killed and damaged in every way that a user may meet.

python -m esc_agents.cli.drill --kills 20        (make drill)
"""

from __future__ import annotations

import sys
from typing import Annotated

from pydantic import BaseModel, ConfigDict, PositiveInt
from tyro import conf

from esc_agents.cli import guarded, parse
from esc_agents.errors import UserError

PROGRAM = "drill"


class DrillArguments(BaseModel):
    """Kill, damage and block training runs; say what each did about it."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    kills: PositiveInt = 20
    """SIGKILLs in the PPO run, and as many in the SAC run."""
    ppo_steps: PositiveInt = 40_000
    sac_steps: PositiveInt = 4_000
    seed: int = 0
    """Of the moments."""
    only: Annotated[tuple[str, ...], conf.arg(metavar="NAME ...")] = ()
    """Rows to go through; default: all."""


def main() -> None:
    """Entry point of ``python -m esc_agents.cli.drill``."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: every row ended as it has to."""
    arguments = parse(PROGRAM, DrillArguments, args)
    from esc_agents.proof.drill import ROWS, go_through

    if unknown := sorted(set(arguments.only) - ROWS.keys()):
        raise UserError(f"--only: expected rows among {', '.join(ROWS)}; got {unknown[0]!r}")
    return 1 if go_through(**dict(arguments)) else 0


if __name__ == "__main__":
    main()
