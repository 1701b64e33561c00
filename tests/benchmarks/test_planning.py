"""A decision of the planner beside the same plan in deep copies of stock environments."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from esc_agents.proof.planning import PLANNER, by_deep_copies
from tests.benchmarks.interleaved import fastest

TOGETHER = 16  # environments for which is decided at once


@pytest.mark.filterwarnings("ignore:.*is out of date")
@pytest.mark.parametrize("env_id", ["highway-fast-v0", "merge-v0", "intersection-v0"])
def test_a_decision_beside_deep_copies(benchmark: Any, env_id: str) -> None:
    envs: Any = gym.make_vec(
        f"esc_gym/{env_id}", TOGETHER, vectorization_mode="vector_entry_point", threads=2
    )
    envs = envs.unwrapped
    envs.reset(seed=0)
    stock = gym.make(env_id).unwrapped
    plans = PLANNER.sequences(envs)
    stock.reset(seed=0)
    np.testing.assert_array_equal(PLANNER.values(envs, [0])[0], by_deep_copies(stock, plans))
    best = fastest(
        {"deepcopy": lambda: by_deep_copies(stock, plans), "planner": lambda: PLANNER.values(envs)},
        rounds=3,
    )
    benchmark.pedantic(PLANNER.values, args=(envs,), rounds=5)
    each = best["planner"] / TOGETHER
    benchmark.extra_info |= {
        "deepcopy / planner": best["deepcopy"] / each, "milliseconds a decision": 1000 * each,
    }  # fmt: skip
    print(env_id, {name: round(value, 1) for name, value in benchmark.extra_info.items()})  # noqa: T201
    assert best["deepcopy"] / each >= 50
