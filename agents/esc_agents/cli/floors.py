"""What policies that never look reach in a scenario: the floor under every result there.

python -m esc_agents.cli.floors --scenarios highway-dense merge-dense --out docs/scenarios.md
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro import conf

from esc_agents.cli import Trust, guarded, parse
from esc_agents.config import Episodes, TrainConfig, load_config, scenarios

PROGRAM = "floors"


@dataclass(frozen=True)
class FloorArguments:
    """Measure the blind policies of scenarios and write the tables."""

    out: Path = Path("docs/scenarios.md")
    """Markdown file to write."""
    scenarios: Annotated[tuple[str, ...], conf.arg(metavar="NAME ...")] = field(
        default_factory=lambda: tuple(name for name in scenarios() if name.endswith("-dense"))
    )
    episodes: Episodes = 30
    trust: Trust = False


def main() -> None:
    """Entry point of ``python -m esc_agents.cli.floors``."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: done."""
    arguments = parse(PROGRAM, FloorArguments, args)
    configs = {name: load_config(name, arguments.trust) for name in arguments.scenarios}
    from esc_agents.driving.baselines import write_floors

    write_floors(configs, arguments.episodes, TrainConfig().evaluation.seed, arguments.out)
    return 0


if __name__ == "__main__":
    main()
