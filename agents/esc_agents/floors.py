"""What policies that never look reach in a scenario: the floor under every result there.

python -m esc_agents.floors --scenarios highway-dense merge-dense --out docs/scenarios.md
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import PositiveInt
from tyro import conf

from esc_agents import run
from esc_agents.cli import guarded, parse
from esc_agents.config import TrainConfig, load_config, scenarios
from esc_agents.evaluate import Summary, blind_policies, evaluate
from esc_agents.report import markdown
from esc_agents.train import action_names, check, closing, say, vectorise


@dataclass(frozen=True)
class FloorArguments:
    """Measure the blind policies of scenarios and write the tables."""

    out: Path = Path("docs/scenarios.md")
    """Markdown file to write."""
    scenarios: Annotated[tuple[str, ...], conf.arg(metavar="NAME ...")] = field(
        default_factory=lambda: tuple(name for name in scenarios() if name.endswith("-dense"))
    )
    episodes: PositiveInt = 30


def main() -> None:
    """Entry point of ``python -m esc_agents.floors``."""
    guarded("floors", lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: done."""
    arguments = parse("floors", FloorArguments, args)
    configs = {name: load_config(name) for name in arguments.scenarios}
    found = run.versions()
    text = [
        "# Blind policies",
        "",
        f"Written by `python -m esc_agents.floors --scenarios {' '.join(configs)} --episodes "
        f"{arguments.episodes}`: {arguments.episodes} episodes each, seeds from "
        f"{TrainConfig().evaluation.seed} on; brackets hold 95 % intervals. "
        + ", ".join(f"{name} {version}" for name, version in found.items())
        + ".",
    ]
    for name, config in configs.items():
        say(f"{name} ...")
        text += ["", f"## {name}", "", markdown(floors(config, arguments.episodes))]
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    run.write_text(arguments.out, "\n".join(text) + "\n")
    say(f"Written: {arguments.out}")
    return 0


def floors(config: TrainConfig, episodes: int) -> dict[str, Summary]:
    """Every blind policy of a scenario on ``episodes`` fixed seeds."""
    probe = check(config)
    seed = config.evaluation.seed
    seeds = range(seed, seed + episodes)
    count = min(config.n_envs, episodes)
    with closing(vectorise(config, count, evaluation=True)) as envs:
        blind = blind_policies(probe.action_space, count, action_names(probe), seed)
        return {name: Summary.of(evaluate(envs, policy, seeds)) for name, policy in blind.items()}


def rule_driver(config: TrainConfig, episodes: int) -> Summary:
    """highway-env's own driver, IDM and MOBIL, in the ego's place on the same seeds."""
    seeds = range(config.evaluation.seed, config.evaluation.seed + episodes)
    count = min(config.n_envs, episodes)
    with closing(vectorise(config, count, evaluation=True, rule_driver=True)) as envs:
        space = envs.action_space
        ignored = np.zeros((count, *(space.shape or ())), space.dtype)
        return Summary.of(evaluate(envs, lambda observations: ignored, seeds))


if __name__ == "__main__":
    main()
