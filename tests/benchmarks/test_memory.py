"""Memory over a long run of accelerated steps with resets."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import pytest

import esc_gym

STEPS, WARM_UP = 200_000, 20_000


def resident_megabytes() -> float:
    pages = Path("/proc/self/statm").read_text().split()[1]
    return int(pages) * 4096 / 1e6


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads Linux's /proc")
def test_memory_does_not_grow():
    ids = ("highway-fast-v0", "intersection-v0", "roundabout-v0", "racetrack-v0")
    envs = [gym.make(f"esc_gym/{env_id}", disable_env_checker=True) for env_id in ids]
    for number, env in enumerate(envs):
        env.reset(seed=number)
        env.action_space.seed(number)
    before = 0.0
    for step in range(STEPS // len(envs)):
        if step == WARM_UP // len(envs):
            before = resident_megabytes()
        for env in envs:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()
    grown = resident_megabytes() - before
    reports = [esc_gym.fastsim.report(env) for env in envs]
    assert sum(report.compiled for report in reports) >= STEPS
    print({"steps": STEPS, "MB": round(before, 1), "grown by MB": round(grown, 2)})  # noqa: T201
    assert grown < 0.01 * before
