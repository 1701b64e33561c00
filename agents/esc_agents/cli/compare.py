"""esc-compare: representations side by side, on the same sets of vehicles."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from pathlib import Path
from typing import Literal

from pydantic import PositiveFloat, PositiveInt

from esc_agents.cli import Trust, guarded, parse
from esc_agents.compare.grid import CompareConfig
from esc_agents.config import load
from esc_agents.errors import UserError

PROGRAM = "esc-compare"


class CompareArguments(CompareConfig):
    """Train representations in the same scenarios, and report which drives best.

    What --out holds already is kept: start again to go on, or ask for more to add to it.
    """

    config: str | None = None
    """YAML file, or name of a shipped comparison, with the values of all other flags."""
    out: Path = Path("runs/compare")
    """Directory of the results and the report."""
    engine: Literal["local", "ray"] = "local"
    """local: processes of this machine; ray: a Ray cluster (pip install 'esc-gym[ray]')."""
    workers: PositiveInt | None = None
    """Runs at a time of --engine local; default: as many as cores and memory allow."""
    address: str = "local"
    """Of --engine ray: local starts one, auto finds one that runs here, else host:port."""
    cpus: PositiveFloat = 1.0
    """Of --engine ray: cores that one run takes."""
    dry_run: bool = False
    """Print the grid and what it will take, and train nothing."""
    trust: Trust = False


OWN = ("config", "out", "engine", "workers", "address", "cpus", "dry_run", "trust")


def main() -> None:
    """Entry point of the console script."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: done; 130: interrupted, saved."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    early.add_argument("--config")
    early.add_argument("--trust", action=argparse.BooleanOptionalAction, default=False)
    try:
        given, _ = early.parse_known_args(args)
    except argparse.ArgumentError as error:
        raise UserError(str(error)) from error
    base = CompareConfig()
    if given.config:
        base = load(given.config, "compare", CompareConfig, given.trust)
    arguments = parse(
        PROGRAM, CompareArguments, args, default=CompareArguments.model_construct(**dict(base))
    )
    config = CompareConfig(**{name: v for name, v in dict(arguments).items() if name not in OWN})

    # torch loads once the arguments are right
    from esc_agents.compare.comparison import compare, dry_run
    from esc_agents.compare.engines import LocalEngine, RayEngine

    workers = arguments.workers or fitting()
    if arguments.dry_run:
        dry_run(config, arguments.out, workers, arguments.trust)
        return 0
    local = arguments.engine == "local"
    engine = LocalEngine(workers) if local else RayEngine(arguments.address, arguments.cpus)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        compare(config, arguments.out, engine, arguments.trust)
    except KeyboardInterrupt:
        print("Interrupted; what is finished is kept. Start again to go on.", flush=True)
        return 130
    return 0


def fitting() -> int:
    """Processes that fit this machine: its cores, and 1.5 GiB of memory for each."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not told by this system
        return cores or 1
    return max(1, min(cores or 1, int(memory / (1.5 * 2**30))))


if __name__ == "__main__":
    main()
