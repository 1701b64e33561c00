"""Rewards are sums; how Python adds depends on its version and on the types of the terms."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numba
import numpy as np
from hypothesis import given, settings, strategies as st

from esc_gym.vector.scenes.roads import weighted, weights

floats = st.floats(-1e3, 1e3)
TERMS = st.lists(
    st.tuples(st.one_of(st.integers(-5, 5), floats), st.one_of(st.booleans(), floats)),
    min_size=1, max_size=6,
)  # fmt: skip


@numba.njit
def compiled_sum(parts: Any, c: Any, before: int) -> float:
    return weighted(parts, c, before)


@settings(deadline=None)  # the first call compiles
@given(TERMS, st.integers(0, 6))
def test_a_reward_is_added_up_as_python_does(terms, before):
    """Integers, floats and, from ``before`` on, NumPy's floats."""
    before = min(before, len(terms))
    rewards = {str(index): type(part) for index, (_, part) in enumerate(terms)}
    config = {str(index): weight for index, (weight, _) in enumerate(terms)}
    parts = [part if i < before else np.float64(part) for i, (_, part) in enumerate(terms)]
    expected = sum(config[name] * part for name, part in zip(rewards, parts, strict=True))
    found = compiled_sum(np.array(parts, float), np.array(weights(config, rewards)), before)
    assert found == expected


def test_weights_that_are_not_pythons_numbers_are_left_to_single_environments():
    config = {"right_lane_reward": np.float32(0.1)}
    envs: Any = gym.make_vec("esc_gym/highway-fast-v0", 2, config=config)
    assert "not Python's numbers" in str(envs.unwrapped.report())
    envs.close()
