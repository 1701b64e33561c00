"""esc-collect: a data set of episodes in which an expert labelled every step."""

from __future__ import annotations

import sys
from pathlib import Path

from esc_agents.cli import Trust, early, guarded, parse
from esc_agents.config import config_for_env
from esc_agents.imitation.settings import CollectConfig

PROGRAM = "esc-collect"


class CollectArguments(CollectConfig):
    """Drive with an expert, and write a Minari data set of observations, actions, and what the
    expert thought of every action: esc-collect --env NAME --expert planner."""

    out: Path | None = None
    """Directory of the data set; its name ends with a version, as -v0. Default:
    runs/data/<env>-<expert>-v0."""
    trust: Trust = False


def main() -> None:
    """Entry point of the console script."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: done; 130: interrupted, kept."""
    env = early(args, "--env").env
    scenario = config_for_env(CollectConfig().env if env is None else env)
    base = CollectArguments(observation=scenario.observation)
    arguments = parse(PROGRAM, CollectArguments, args, default=base)
    config = CollectConfig(
        **{name: getattr(arguments, name) for name in CollectConfig.model_fields}
    )
    from esc_agents.imitation.collect import collect

    expert = "run" if config.expert.startswith("run:") else config.expert
    out = arguments.out or Path("runs") / "data" / f"{config.env}-{expert}-v0"
    return 0 if collect(config, out, arguments.trust) else 130


if __name__ == "__main__":
    main()
