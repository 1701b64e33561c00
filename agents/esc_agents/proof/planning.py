"""A planner's decision, in copies of the engine's scenes, and in deep copies of stock ones."""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import deepcopy
from typing import Any, cast

import gymnasium as gym
import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from numpy.typing import NDArray

from esc_agents.driving.environments import named_version
from esc_agents.proof.timing import milliseconds, ratio
from esc_gym.fastsim.behavior import original_behavior
from esc_gym.planning import LookAhead
from esc_gym.registration import NAMESPACE
from esc_gym.vector.environment import SetVectorEnv

IDS = ("highway-v0", "highway-fast-v0", "merge-v0", "roundabout-v0", "intersection-v0")
TOGETHER = 16
PLANNER = LookAhead(free=1)
TWICE = LookAhead()
COLUMNS = (
    "environment", "deepcopy ms", "planner ms", f"{TOGETHER} at once ms", "beside deepcopy",
    "observed ms", "two free steps ms", "values",
)  # fmt: skip
TEXT = f"""## Planning

Milliseconds of a decision, in the state after a reset. Deepcopy: every action, then IDLE or SLOWER,
{PLANNER.horizon} steps in all, each in a deep copy of stock highway-env, as planners have it that
know no other way. Planner: the same plan by `esc_gym.planning.LookAhead(free=1)`, on one processor;
and of each environment where it decides for {TOGETHER} at once, which is what is set beside
deepcopy. Observed: the same with `knows="observed"`, {PLANNER.futures} guesses of what cannot be
seen. Two free steps: every pair of first actions, what `esc-eval --expert planner` does. Sides take
turns, the fastest counts. Values: whether both sides say the same of every action, to the last bit.
"""


def measure(id: str, seconds: float) -> list[str]:
    """The row of an id."""
    with original_behavior(IDMVehicle), named_version():
        stock = gym.make(id, disable_env_checker=True)
        envs = cast(SetVectorEnv, gym.make_vec(f"{NAMESPACE}/{id}", TOGETHER))
        try:
            stock.reset(seed=0)
            envs.reset(seed=0)
            plans = PLANNER.sequences(envs)
            expected = by_deep_copies(stock, plans)
            same = (PLANNER.values(envs, [0])[0] == expected).all()
            sides: list[Callable[[], Any]] = [
                lambda: by_deep_copies(stock, plans),
                lambda: PLANNER.values(envs, [0]),
                lambda: PLANNER.values(envs),
                lambda: LookAhead(free=1, knows="observed").values(envs),
                lambda: TWICE.values(envs),
            ]
            copied, alone, *many = fastest(sides, seconds)
        finally:
            stock.close()
            envs.close()
    together, observed, twice = (taken / TOGETHER for taken in many)
    times = [copied, alone, together, observed, twice]
    copied_ms, alone_ms, together_ms, *others = map(milliseconds, times)
    return [
        id, copied_ms, alone_ms, together_ms, ratio(copied, together), *others,
        "equal" if same else "DIFFER",
    ]  # fmt: skip


def by_deep_copies(env: gym.Env, plans: NDArray) -> NDArray:
    """Values of the actions, of ``LookAhead.sequences``."""
    returns = np.zeros(plans.shape[:2])
    for place in np.ndindex(*plans.shape[:2]):
        copy = deepcopy(env)
        for step, action in enumerate(plans[place].tolist()):
            _, reward, terminated, truncated, _ = copy.step(action)
            crashed = terminated and cast(Any, copy.unwrapped).vehicle.crashed
            worth = float(reward) - PLANNER.crash_cost * crashed
            returns[place] += PLANNER.discount**step * worth
            if terminated or truncated:
                break
    return returns.max(axis=1)


def fastest(sides: list[Callable[[], Any]], seconds: float) -> list[float]:
    """Of each side the shortest time; they take turns for about ``seconds``, two at least."""
    times: list[list[float]] = [[] for _ in sides]
    begun = time.perf_counter()
    while len(times[-1]) < 2 or time.perf_counter() - begun < seconds:
        for side, taken in zip(sides, times, strict=True):
            before = time.perf_counter()
            side()
            taken.append(time.perf_counter() - before)
    return [min(taken) for taken in times]
