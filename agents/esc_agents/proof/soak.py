"""Every scenario for a long time, with random actions: what must never happen, counted."""

from __future__ import annotations

import ctypes
import gc
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from esc_agents import files
from esc_agents.config import TrainConfig, load_config, scenarios
from esc_agents.driving.environments import check_actions
from esc_agents.driving.vectorised import vectorise
from esc_agents.errors import UserError, say
from esc_agents.reporting.documents import Rows, Text

ENVIRONMENTS = 64  # of a scenario at once
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
    """Drive at least ``steps`` random steps, through as many episodes as they make."""
    result = Soaked(name, "meta" if config.algo == "ppo" else "continuous")
    start = time.perf_counter()
    generator = np.random.default_rng(seed)
    envs = begun(config, seed)
    while result.steps < steps:
        observations, _, dones, infos = envs.step(drawn(envs.action_space, generator))
        result.steps += ENVIRONMENTS
        result.episodes += int(dones.sum())
        if not contains(envs.observation_space, observations):
            result.faults.append(f"step {result.steps:,}: an observation outside its space")
        if found := [info["fault"] for info in infos if "fault" in info]:
            result.faults += found
            envs.close()
            envs = begun(config, seed + result.steps)
        if not result.memory and result.steps >= WARM_UP * steps:
            result.memory.append(resident())
    result.memory.append(resident())
    envs.close()
    result.seconds = time.perf_counter() - start
    return result


def begun(config: TrainConfig, seed: int) -> VecEnv:
    """The environments of a scenario, reset."""
    envs = vectorise(config, ENVIRONMENTS)
    envs.seed(seed)
    envs.reset()
    return envs


def drawn(space: gym.Space, generator: np.random.Generator) -> NDArray:
    """A random action for each environment."""
    if isinstance(space, gym.spaces.Discrete):
        return generator.integers(space.n, size=ENVIRONMENTS)
    box: Any = space
    return generator.uniform(box.low, box.high, (ENVIRONMENTS, *box.shape)).astype(box.dtype)


def contains(space: Any, observations: Any) -> bool:
    """Whether every observation of a batch is in its space."""
    boxes = all(
        observations[name].dtype == space[name].dtype
        and (space[name].low <= observations[name]).all()
        and (observations[name] <= space[name].high).all()
        for name in ("ego", "vehicles")
    )
    return boxes and bool(np.isin(observations["mask"], (0, 1)).all())


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
