"""Environments in the middle of an episode, and plans in deep copies of them."""

from __future__ import annotations

from copy import deepcopy

import numpy as np

from esc_gym.planning import OWN
from tests.esc_gym.vector.stock import batch, stock

IDS = ["esc_gym/highway-fast-v0", "esc_gym/merge-v0", "esc_gym/intersection-v0"]


def driven(env_id, count=2, steps=3, **arguments):
    """A batch in the middle of its first episodes, and stock environments in the same places."""
    envs = batch(env_id, count, {}, **arguments)
    envs.reset(seed=7)
    others = [stock(env_id, {}) for _ in range(count)]
    for seed, other in enumerate(others, 7):
        other.reset(seed=seed)
    space = envs.single_action_space
    for step in range(steps):
        action = step % space.n if hasattr(space, "n") else np.float32([0.1] * space.shape[0])
        envs.step(np.stack([action] * count))
        for other in others:
            other.step(action)
    return envs, others


def by_deep_copies(env, sequences, planner, policy=None):
    """The returns of sequences of actions, each in a deep copy of ``env``; and how many crash."""
    returns, crashes = [], 0
    for sequence in sequences:
        copy, total, seen = deepcopy(env), 0.0, None
        for step, action in enumerate(sequence.tolist()):
            if action == OWN:
                (action,) = policy({name: part[None] for name, part in seen.items()})
            action = np.float32(action) if isinstance(action, list) else action
            seen, reward, terminated, truncated, _ = copy.step(action)
            crashed = terminated and copy.unwrapped.vehicle.crashed
            crashes += crashed
            total += planner.discount**step * (float(reward) - planner.crash_cost * crashed)
            if terminated or truncated:
                break
        returns.append(total)
    return returns, crashes


def restless(observations):
    """A policy of three actions that depends on the set and on the ego."""
    seen = observations["vehicles"].sum(axis=(1, 2)) + observations["ego"].sum(axis=1)
    return (1000 * np.abs(seen)).astype(int) % 3
