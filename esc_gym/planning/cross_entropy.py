"""Continuous actions: sequences are drawn, and drawn again around the best of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from esc_gym.planning.guesses import entropy
from esc_gym.planning.planner import Planner, Scenes
from esc_gym.vector.environment import SetVectorEnv


@dataclass(frozen=True, kw_only=True)
class CrossEntropy(Planner):
    """The cross-entropy method (Rubinstein, 1999; for planning: Kobilarov, 2012).

    samples: sequences in each iteration, the middle of what they are drawn from among them. elites:
    how many of the best the next ones are drawn around. hold: policy steps for which an action
    lasts. spread: standard deviation at the beginning, as a share of half the range of an action.
    The first action of the best sequence found is done.

    Raises ValueError for a number below 1, a spread below 0, or more elites than samples.
    """

    horizon: int = 20
    samples: int = 64
    elites: int = 8
    iterations: int = 4
    hold: int = 4
    spread: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        self._at_least_1("samples", "elites", "iterations", "hold")
        if self.elites > self.samples:
            raise ValueError(
                f"elites: expected at most the samples, {self.samples}, got {self.elites}"
            )
        if self.spread < 0:
            raise ValueError(f"spread: expected at least 0, got {self.spread}")

    def check(self, envs: SetVectorEnv) -> None:
        """Raises ValueError where actions are not continuous."""
        _box(envs)

    def actions(
        self, envs: SetVectorEnv, indices: Sequence[int] | NDArray | None = None
    ) -> NDArray[np.float32]:
        """The best action found in each environment, or each of ``indices``: [K, *action]."""
        space, scenes = _box(envs), Scenes(self, envs, indices)
        generators = [
            np.random.default_rng(entropy(envs, e, self.seed)) for e in scenes.places.tolist()
        ]
        count, held = len(generators), -(-self.horizon // self.hold)
        low, high = space.low, space.high
        middle = np.broadcast_to((low + high) / 2, (count, held, *space.shape)).astype(float)
        around = np.broadcast_to(self.spread * (high - low) / 2, middle.shape).astype(float)
        everyone = np.arange(count)
        done, worth = middle[:, 0].copy(), np.full(count, -np.inf)
        for _ in range(self.iterations):
            noise = [drawn.normal(size=(self.samples, *middle.shape[1:])) for drawn in generators]
            tried = middle[:, None] + around[:, None] * np.array(noise)
            tried[:, 0] = middle
            tried = np.clip(tried, low, high).astype(space.dtype)  # type: ignore[arg-type]
            plans = np.repeat(tried, self.hold, axis=2)[:, :, : self.horizon]
            returns = scenes.returns(everyone, plans)
            order = np.argsort(-returns, axis=1, kind="stable")
            chosen = tried[everyone[:, None], order[:, : self.elites]]
            middle, around = chosen.mean(axis=1, dtype=float), chosen.std(axis=1, dtype=float)
            best = returns.max(axis=1)
            better = best > worth
            done[better] = chosen[better, 0, 0]
            worth = np.maximum(worth, best)
        return done.astype(space.dtype)  # type: ignore[arg-type]


def _box(envs: SetVectorEnv) -> gym.spaces.Box:
    space = envs.single_action_space
    if not isinstance(space, gym.spaces.Box):
        raise ValueError(f"expected an environment with continuous actions, got {space}")
    return space
