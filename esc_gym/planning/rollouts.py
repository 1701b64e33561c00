"""Copies of scenes, driven on: what sequences of actions are worth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from esc_gym.vector.environment import SetVectorEnv
from esc_gym.vector.state import RUNNING

NEUTRAL = "IDLE"
OWN = -1
"""In a sequence of meta-actions: whatever a policy does there."""
Policy = Callable[[dict[str, NDArray]], NDArray]
"""Observations of K environments -> their actions [K]."""


def rollouts(
    envs: SetVectorEnv, indices: Any, actions: NDArray, discount: float = 1.0,
    crash_cost: float = 0.0, policy: Policy | None = None,
) -> NDArray:  # fmt: skip
    """Discounted returns of sequences of actions, driven in copies of environments.

    indices [K]: the environment that each begins in. actions [K, H, ...]; policy: what it does is
    done instead of OWN, after the first step. crash_cost: taken from the reward of a step that ends
    an episode with the ego crashed. Returns [K]; nothing is earned after the end of an episode.
    """
    driven = copies(envs, indices)
    returns, seen = np.zeros(driven.num_envs), {}
    for step in range(actions.shape[1]):
        taken = actions[:, step]
        if policy and step and (own := taken == OWN).any():
            taken = taken.copy()
            taken[own] = policy({name: part[own] for name, part in seen.items()})
        seen, rewards, terminated, truncated = driven.advance(taken)
        crashed = terminated & driven.engine.now.told.crashed
        returns += discount**step * (rewards - crash_cost * crashed)
        driven.rest(terminated | truncated)
    driven.close()
    return returns


def copies(envs: SetVectorEnv, indices: Any) -> SetVectorEnv:
    """Copies that are driven on and left: resets would cost time, and draw random numbers."""
    made = envs.fork(indices)
    made.autoreset_mode = made.engine.mode = AutoresetMode.DISABLED
    made.rest(made.engine.state.heads["over"] != RUNNING)
    return made


def best(values: NDArray, numbers: dict[str, int]) -> NDArray[np.int64]:
    """The action with the highest of ``values`` [K, A]; of equally good ones IDLE, else the first.

    numbers: of ``meta_actions``.
    """
    neutral = numbers.get(NEUTRAL, 0)
    return np.where(values[:, neutral] == values.max(axis=1), neutral, values.argmax(axis=1))


def meta_actions(envs: SetVectorEnv) -> dict[str, int]:
    """Numbers of the meta-actions, by highway-env's names for them; ValueError without any."""
    space = envs.single_action_space
    base: Any = envs.engine.env.unwrapped if envs.engine else envs.materialise(0).unwrapped
    names = getattr(base.action_type, "actions_indexes", None)
    if names is None or not isinstance(space, gym.spaces.Discrete):
        raise ValueError(f"expected an environment with meta-actions, got the actions {space}")
    return dict(names)
