"""esc-bench: the accelerated environments beside stock highway-env."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import tyro
from pydantic import BaseModel, ConfigDict, PositiveFloat, PositiveInt

from esc_agents.cli import guarded, parse
from esc_gym.registration import HIGHWAY_ENV_IDS

PROGRAM = "esc-bench"


class BenchArguments(BaseModel):
    """Measure environments beside stock highway-env, and compare what they do to the last bit."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    envs: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID [ID ...]")] = HIGHWAY_ENV_IDS
    """highway-env ids; default: all."""
    seeds: PositiveInt = 3
    """Episodes in each round, of a few steps each."""
    seconds: PositiveFloat = 5.0
    """Time for each id, and for each turn in training; two turns are taken in any case."""
    batch: bool = False
    """Also measure batches of 64 environments, and how their cost grows."""
    end_to_end: bool = False
    """Also measure PPO training, on highway-v0 and highway-fast-v0."""
    planning: bool = False
    """Also measure a planner's decisions, beside the same plans in deep copies of stock."""
    out: Path | None = None
    """Markdown file to write, such as docs/speed.md."""
    readme: Path | None = None
    """Markdown file in which the -v0 ids replace what is between the esc-bench markers."""


def main() -> None:
    """Entry point of the console script."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: done; 1: done, but somewhere the trajectories differ."""
    arguments = parse(PROGRAM, BenchArguments, args)
    from esc_agents.proof.bench import benchmark

    return 0 if benchmark(**dict(arguments), command=shlex.join([PROGRAM, *args])) else 1


if __name__ == "__main__":
    main()
