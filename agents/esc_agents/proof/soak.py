"""Every scenario for a long time, with random actions: what must never happen, counted."""

from __future__ import annotations

import copy
import ctypes
import gc
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from esc_agents import files
from esc_agents.config import TrainConfig, load_config, scenarios
from esc_agents.driving.environments import EnvFactory, check_actions
from esc_agents.errors import UserError, say
from esc_agents.reporting.documents import Rows, Text

WARM_UP = 0.1  # share of the steps after which memory is first measured
HEADER = ("scenario", "actions", "steps", "episodes", "faults", "memory MB", "growth")


@dataclass
class Soaked:
    """What came of one scenario. memory: resident, after warm-up and at the end [bytes]."""

    scenario: str
    actions: str
    steps: int = 0
    episodes: int = 0
    faults: list[str] = field(default_factory=list)
    memory: list[int] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def growth(self) -> float:
        """Share by which memory grew after warm-up."""
        return self.memory[-1] / self.memory[0] - 1


def cases() -> list[tuple[str, TrainConfig]]:
    """Every scenario, with each kind of actions that it has."""
    found = []
    for name in scenarios():
        for algo in ("ppo", "sac"):
            config = load_config(name).model_copy(update={"algo": algo})
            try:
                check_actions(config)
            except UserError:
                continue
            found.append((name, config))
    return found


def soak(name: str, config: TrainConfig, steps: int, seed: int) -> Soaked:
    """Drive ``steps`` random steps, through as many episodes as they make."""
    result = Soaked(name, "meta" if config.algo == "ppo" else "continuous")
    start = time.perf_counter()
    env = EnvFactory(config)()
    observation, _ = env.reset(seed=seed)
    actions = copy.deepcopy(env.action_space)  # every reset makes another one, without seed
    actions.seed(seed)
    for result.steps in range(1, steps + 1):
        if not env.observation_space.contains(observation):
            result.faults.append(f"step {result.steps}: an observation outside its space")
        observation, _, terminated, truncated, info = env.step(actions.sample())
        if fault := info.get("fault"):
            result.faults.append(fault)
            env = EnvFactory(config)()
            terminated = True
        if terminated or truncated:
            result.episodes += 1
            observation, _ = env.reset(seed=seed + result.steps if fault else None)
        if result.steps == max(1, int(WARM_UP * steps)):
            result.memory.append(resident())
    result.memory.append(resident())
    env.close()
    result.seconds = time.perf_counter() - start
    return result


def resident() -> int:
    """Resident memory, without what only waits for Python's collector or for malloc to trim."""
    gc.collect()
    try:
        ctypes.CDLL(None).malloc_trim(0)
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    except (OSError, AttributeError) as error:
        raise UserError("soak measures memory as Linux with glibc does") from error
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def soak_all(steps: int, seed: int, out: Path) -> list[Soaked]:
    """Share ``steps`` out among all scenarios, and write the page about it."""
    chosen, found = cases(), []
    for name, config in chosen:
        found.append(soak(name, config, -(-steps // len(chosen)), seed))
        say(" | ".join(cells(found[-1])))
    out.parent.mkdir(parents=True, exist_ok=True)
    files.write_text(out, text(found, steps, seed, out))
    say(verdict(found))
    return found


def cells(result: Soaked) -> list[str]:
    """A row of the table."""
    megabytes = " to ".join(f"{size / 1e6:.1f}" for size in result.memory)
    return [
        result.scenario, result.actions, f"{result.steps:,}", f"{result.episodes:,}",
        str(len(result.faults)), megabytes, f"{result.growth:+.2%}",
    ]  # fmt: skip


def verdict(found: list[Soaked]) -> str:
    """The sum of it, in a sentence."""
    first, last = found[0].memory[0], found[-1].memory[-1]
    return (
        f"{sum(r.steps for r in found):,} steps, {sum(r.episodes for r in found):,} episodes, "
        f"{sum(len(r.faults) for r in found)} faults; memory grew by at most "
        f"{max(r.growth for r in found):.2%} in a scenario after its warm-up, from "
        f"{first / 1e6:.0f} to {last / 1e6:.0f} MB over all of them in one process."
    )


def text(found: list[Soaked], steps: int, seed: int, out: Path) -> str:
    """The page."""
    faults = sorted({fault for result in found for fault in result.faults})
    versions = ", ".join(f"{name} {version}" for name, version in files.versions().items())
    parts: list[Any] = [
        "# Reliability",
        "## Soak",
        verdict(found),
        "Random actions in every scenario. A fault is an exception, a number that is NaN or "
        "infinite, or an observation outside its space. Memory is resident memory of the process "
        f"after {WARM_UP:.0%} of the steps and at the end.",
        Rows([HEADER, *map(cells, found)]).markdown(),
        *([Text("\n".join(faults), bullets=True).markdown()] if faults else []),
        f"Written by `python -m esc_agents.cli.soak --steps {steps} --seed {seed} --out "
        f"{out}`; {versions}, device cpu, "
        f"{sum(result.seconds for result in found) / 60:.0f} minutes.",
    ]
    return "\n\n".join(parts) + "\n"
