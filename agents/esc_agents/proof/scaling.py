"""Batches of environments beside environments one by one, and how their cost grows."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from stable_baselines3.common.vec_env import DummyVecEnv

from esc_agents import files
from esc_agents.driving.environments import named_version
from esc_agents.proof.timing import in_own_process, ratio, significant
from esc_agents.reporting.plots import COLORS, tidy
from esc_gym import SetVecEnv
from esc_gym.registration import NAMESPACE

ENVIRONMENTS, THREADS = 64, 2
STEPS = 8  # of all environments, between two looks at the clock
VISITS = 2  # to each id, all others between them: what else a machine does comes in bursts
COLUMNS = (
    "environment", "stock steps/s", f"{ENVIRONMENTS} one by one steps/s", "batch steps/s",
    "beside one by one", "beside stock",
)  # fmt: skip
COUNTS, VEHICLES = (1, 4, 16, 64, 256, 1024), (10, 25, 50, 100, 200, 400)
TEXT = f"""## Batches

Environment steps per second with random actions, resets included: one stock environment,
`gym.make(id)`; {ENVIRONMENTS} accelerated ones, `gym.make("esc_gym/" + id)`, in SB3's
`DummyVecEnv`; and `esc_gym.SetVecEnv(id, {ENVIRONMENTS}, threads={THREADS})`. Each id has a process
of its own, in which they take turns, and is visited {VISITS} times, minutes apart; of each side
the mean over the faster visit counts.
"""
GROWTH_TEXT = """![What a step costs with more environments and with more vehicles]({name})

Left: a step of one environment of highway-fast-v0 in batches of more and more. Right: of highway-v0
with more and more vehicles, in a batch of {environments} with one thread, each vehicle's share of a
step:
{shares}.
"""


@dataclass(frozen=True)
class BatchSpeed:
    """Seconds of one environment's step in one id: stock, single and in a batch."""

    id: str
    stock: float
    single: float
    batch: float

    def fastest(self, other: BatchSpeed) -> BatchSpeed:
        """Each side as fast as it was in either of two visits."""
        return BatchSpeed(
            self.id, min(self.stock, other.stock), min(self.single, other.single),
            min(self.batch, other.batch),
        )  # fmt: skip

    def cells(self) -> list[str]:
        """The row of the table."""
        rates = [significant(1 / value) for value in (self.stock, self.single, self.batch)]
        return [
            self.id, *rates, ratio(self.single, self.batch), ratio(self.stock, self.batch),
        ]  # fmt: skip


def measure_batch(id: str, seconds: float) -> BatchSpeed:
    """Race the three sides of an id for about ``seconds``, at least two rounds."""
    with named_version():
        stock = DummyVecEnv([lambda: gym.make(id, disable_env_checker=True)])
        single = DummyVecEnv([lambda: gym.make(f"{NAMESPACE}/{id}")] * ENVIRONMENTS)
        sides = [
            driver(stock, 1),
            driver(single, STEPS),
            driver(SetVecEnv(id, ENVIRONMENTS, THREADS), 4 * STEPS),
        ]
    deadline, rounds = time.perf_counter() + seconds, []
    while len(rounds) < 2 or time.perf_counter() < deadline:
        rounds.append([side(seconds / 6) for side in sides])
    # Not the fastest round: of stock it holds a dozen steps, and some traffic costs half of other.
    return BatchSpeed(id, *np.mean(rounds, axis=0))


def driver(envs: Any, steps: int) -> Callable[[float], float]:
    """What drives environments for some seconds, and says how long one's step took."""
    envs.seed(0)
    envs.reset()
    rng, space = np.random.default_rng(0), envs.action_space

    def drive(seconds: float) -> float:
        taken, count = 0.0, 0
        while taken < seconds:
            shape = steps, envs.num_envs, *space.shape
            if space.shape:
                actions: Any = rng.uniform(-1, 1, shape).astype(space.dtype)
            else:
                actions = rng.integers(space.n, size=shape)
            before = time.perf_counter()
            for action in actions:
                envs.step(action)
            taken += time.perf_counter() - before
            count += steps * envs.num_envs
        return taken / count

    drive(0.2)  # compiled, and no longer in the first episodes
    return drive


@dataclass(frozen=True)
class Growth:
    """Seconds of a step by [threads][environments], and of a vehicle's share by [vehicles]."""

    environments: dict[int, list[float]]
    vehicles: list[float]

    def shares(self) -> str:
        """The cost of a vehicle, in words."""
        costs = zip(VEHICLES, self.vehicles, strict=True)
        said = [f"{1e6 * cost:.2f} us of {count}" for count, cost in costs]
        return f"{', '.join(said)}; at most {max(self.vehicles) / min(self.vehicles):.2f} times"


def measure_growth(seconds: float) -> Growth:
    """Measure it, for about ``seconds`` each, in turns, of which the fastest counts."""

    def fastest(batches: Sequence[SetVecEnv]) -> list[float]:
        sides = [driver(envs, STEPS) for envs in batches]
        return np.min([[side(seconds / 6) for side in sides] for _ in range(6)], axis=0).tolist()

    environments = {
        threads: fastest([SetVecEnv("highway-fast-v0", count, threads) for count in COUNTS])
        for threads in (1, THREADS)
    }
    configs = [{"vehicles_count": count} for count in VEHICLES]
    costs = fastest([SetVecEnv("highway-v0", ENVIRONMENTS, config=config) for config in configs])
    return Growth(environments, [cost / (n + 1) for cost, n in zip(costs, VEHICLES, strict=True)])


def growth_text(seconds: float, out: Path, say: Callable[[str], None]) -> str:
    """Measure growth, draw it beside the page ``out``, and what to say about it there."""
    growth, picture = measure_growth(seconds), out.with_name(f"{out.stem}-batches.png")
    draw(growth, picture)
    say(f"Written: {picture}")
    return GROWTH_TEXT.format(name=picture.name, environments=ENVIRONMENTS, shares=growth.shares())


def draw(growth: Growth, path: Path) -> None:
    """Both curves, as a picture."""
    figure = Figure(figsize=(8, 3), layout="constrained")
    left, right = figure.subplots(1, 2)
    for (threads, costs), colour in zip(growth.environments.items(), COLORS.values(), strict=False):
        label = f"{threads} thread{'s' * (threads > 1)}"
        left.plot(COUNTS, [1e6 * cost for cost in costs], "o-", color=colour, label=label)
    left.set(xscale="log", xlabel="environments", ylabel="us per environment step", ylim=(0, None))
    left.legend(frameon=False)
    shares = [1e6 * share for share in growth.vehicles]
    right.plot(VEHICLES, shares, "o-", color=COLORS["esc"])
    right.set(xscale="log", xlabel="vehicles", ylabel="us per vehicle and step")
    right.set_ylim(0, 1.2 * max(shares))  # where all are alike, matplotlib's own margin is none
    for axes, ticks in ((left, COUNTS), (right, VEHICLES)):
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.minorticks_off()
        tidy(axes)
    files.write_atomically(path, lambda file: figure.savefig(file, format="png", dpi=150))


def rows(ids: Sequence[str], seconds: float, say: Callable[[str], None]) -> list[Sequence[str]]:
    """The table of batches."""
    speeds: dict[str, BatchSpeed] = {}
    for number, id in enumerate([*ids] * VISITS, 1):
        speed = in_own_process(measure_batch, id, seconds)
        speeds[id] = speed.fastest(speeds.get(id, speed))
        _, stock, single, batch, times, over_stock = speeds[id].cells()
        say(
            f"[{number}/{VISITS * len(ids)}] {id}: {stock}, {single} -> {batch} steps/s, {times} "
            f"and {over_stock}"
        )
    return [COLUMNS, *(speed.cells() for speed in speeds.values())]
