"""The set observation against highway-env's Kinematics: the same vehicles, the same N = 50."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import pytest
from highway_env.envs.common.observation import observation_factory

from tests.benchmarks.interleaved import fastest

KINEMATICS = {
    "type": "Kinematics",
    "vehicles_count": 50,
    "features": ["presence", "x", "y", "vx", "vy", "cos_h", "sin_h"],
    "see_behind": True,
}
BATCH = 100  # calls of ours for one of stock, which takes milliseconds


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_set_observation_is_150_times_cheaper(benchmark: Any, seed: int) -> None:
    env: Any = gym.make("esc_gym/highway-v0", disable_env_checker=True)
    env.reset(seed=seed)
    env.step(1)
    ours = env.unwrapped.observation_type
    stock = observation_factory(env.unwrapped, KINEMATICS)
    runs = {"stock": stock.observe, "ours": lambda: [ours.observe() for _ in range(BATCH)]}
    best = fastest(runs, rounds=200)
    benchmark.pedantic(ours.observe, rounds=50)
    ratio = BATCH * best["stock"] / best["ours"]
    benchmark.extra_info |= {"stock / ours": ratio, "M": ours.info["count"]}
    print({name: round(value, 1) for name, value in benchmark.extra_info.items()})  # noqa: T201
    assert ratio >= 150
