"""What commands that run many trainings have in common: where they run, and how they end."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeVar

from pydantic import PositiveFloat, PositiveInt

from esc_agents.cli import early
from esc_agents.config import Model, load

M = TypeVar("M", bound=Model)


class EngineArguments(Model):
    """Where trainings run."""

    engine: Literal["local", "ray"] = "local"
    """local: processes of this machine; ray: a Ray cluster (pip install 'esc-gym[ray]')."""
    workers: PositiveInt | None = None
    """Runs at a time of --engine local; default: as many as cores and memory allow."""
    address: str = "local"
    """Of --engine ray: local starts one, auto finds one that runs here, else host:port."""
    cpus: PositiveFloat = 1.0
    """Of --engine ray: cores that one run takes."""

    @property
    def at_a_time(self) -> int:
        """How many run at a time on this machine."""
        return self.workers or fitting()

    def make(self) -> Any:
        """The engine."""
        # torch loads once the arguments are right
        from esc_agents.compare.engines import LocalEngine, RayEngine

        if self.engine == "local":
            return LocalEngine(self.at_a_time)
        return RayEngine(self.address, self.cpus)


def base_of(args: Sequence[str], kind: str, model: type[M]) -> M:
    """The values behind the flags: of the YAML file that --config names, or the model's own."""
    given = early(args, "--config")
    return load(given.config, kind, model, given.trust) if given.config else model()


def interruptible(work: Callable[[], object]) -> int:
    """0: done; 130: interrupted, saved."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        work()
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
