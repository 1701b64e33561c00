"""Memory over a long run of accelerated steps with resets.

A road and its vehicles refer to each other, in stock highway-env too, so past episodes wait for
Python's garbage collector. How long, depends on how much else the process has loaded: up to a
quarter of that. ``gc.freeze`` leaves that out.
"""

from __future__ import annotations

import gc
from pathlib import Path

import gymnasium as gym
import pytest

import esc_gym

STEPS, WARM_UP = 200_000, 40_000


@pytest.fixture
def _frozen():
    gc.freeze()
    yield
    gc.unfreeze()


def resident_megabytes() -> float:
    pages = Path("/proc/self/statm").read_text().split()[1]
    return int(pages) * 4096 / 1e6


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads Linux's /proc")
@pytest.mark.usefixtures("_frozen")
def test_memory_does_not_grow():
    ids = ("highway-fast-v0", "intersection-v0", "roundabout-v0", "racetrack-v0")
    envs = [gym.make(f"esc_gym/{env_id}", disable_env_checker=True) for env_id in ids]
    for number, env in enumerate(envs):
        env.reset(seed=number)
        env.action_space.seed(number)
    before = 0.0
    for step in range(0, WARM_UP + STEPS, len(envs)):
        if step == WARM_UP:
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
