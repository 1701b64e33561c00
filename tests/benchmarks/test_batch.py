"""64 environments in one call against as many accelerated ones in SB3's DummyVecEnv.

Random actions, resets included, two threads; the copies of a scene beside a deep copy of one.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from esc_gym import SetVecEnv
from tests.benchmarks.interleaved import fastest

ENVIRONMENTS, STEPS = 64, 8
LEAST = {
    "highway-fast-v0": 15, "highway-v0": 8, "merge-v0": 12, "exit-v0": 12, "two-way-v0": 12,
    "u-turn-v0": 12, "roundabout-v0": 12, "intersection-v0": 8, "racetrack-v0": 8,
    "parking-v0": 5,
}  # fmt: skip


def steps(envs: Any, batches: int) -> Any:
    """What takes ``batches`` times STEPS random steps of all environments."""
    space, rng = envs.action_space, np.random.default_rng(0)
    shape = STEPS, envs.num_envs, *space.shape

    def run() -> None:
        for _ in range(batches):
            if space.shape:
                actions = rng.uniform(-1, 1, shape).astype(space.dtype)
            else:
                actions = rng.integers(0, space.n, shape)
            for action in actions:
                envs.step(action)

    return run


@pytest.mark.filterwarnings("ignore:.*is out of date")
@pytest.mark.parametrize("env_id", LEAST)
def test_a_batch_beside_single_environments(benchmark: Any, env_id: str) -> None:
    ours = SetVecEnv(env_id, ENVIRONMENTS, threads=2)
    single = DummyVecEnv([lambda: gym.make(f"esc_gym/{env_id}")] * ENVIRONMENTS)
    for envs in (ours, single):
        envs.seed(0)
        envs.reset()
    runs = {"single": steps(single, 1), "batch": steps(ours, 4)}
    best = fastest(runs, rounds=12)  # two threads want two quiet processors
    benchmark.pedantic(runs["batch"], rounds=3)
    ratio = 4 * best["single"] / best["batch"]
    each = 1e6 * best["batch"] / (4 * STEPS * ENVIRONMENTS)
    benchmark.extra_info |= {"single / batch": ratio, "microseconds a step": each}
    print(env_id, {name: round(value, 1) for name, value in benchmark.extra_info.items()})  # noqa: T201
    assert ratio >= LEAST[env_id]


def test_forks_beside_a_deep_copy(benchmark: Any) -> None:
    envs = SetVecEnv("highway-v0", 4).envs
    envs.reset(seed=0)
    alone = envs.materialise(0)
    best = fastest({"fork": lambda: envs.fork([0] * 6), "deepcopy": lambda: deepcopy(alone)})
    benchmark.pedantic(envs.fork, args=([0] * 6,), rounds=20)
    benchmark.extra_info |= {
        "deepcopy / copy in a fork": 6 * best["deepcopy"] / best["fork"],
        "microseconds for six": 1e6 * best["fork"],
    }
    print({name: round(value, 1) for name, value in benchmark.extra_info.items()})  # noqa: T201
    assert 6 * best["deepcopy"] / best["fork"] >= 40
