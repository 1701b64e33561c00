"""esc-compare: representations side by side, on the same sets of vehicles."""

from __future__ import annotations

import sys
from pathlib import Path

from esc_agents.cli import Trust, guarded, parse
from esc_agents.cli._engines import EngineArguments, base_of, interruptible
from esc_agents.compare.grid import CompareConfig

PROGRAM = "esc-compare"


class CompareArguments(EngineArguments, CompareConfig):
    """Train representations in the same scenarios, and report which drives best.

    What --out holds already is kept: start again to go on, or ask for more to add to it.
    """

    config: str | None = None
    """YAML file, or name of a shipped comparison, with the values of all other flags."""
    out: Path = Path("runs/compare")
    """Directory of the results and the report."""
    dry_run: bool = False
    """Print the grid and what it will take, and train nothing."""
    trust: Trust = False


def main() -> None:
    """Entry point of the console script."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: done; 130: interrupted, saved."""
    base = base_of(args, "compare", CompareConfig)
    arguments = parse(
        PROGRAM, CompareArguments, args, default=CompareArguments.model_construct(**dict(base))
    )
    config = CompareConfig(
        **{name: getattr(arguments, name) for name in CompareConfig.model_fields}
    )

    # torch loads once the arguments are right
    from esc_agents.compare.comparison import compare, dry_run

    if arguments.dry_run:
        dry_run(config, arguments.out, arguments.at_a_time, arguments.trust)
        return 0
    engine = arguments.make()
    return interruptible(lambda: compare(config, arguments.out, engine, arguments.trust))


if __name__ == "__main__":
    main()
