"""A fake env of the size of a unit test."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

N, D1, D2 = 4, 3, 2
HIGH = np.array([1.0, 5.0, 1.0], np.float32)


def space(n: int = N, **parts: spaces.Space) -> spaces.Dict:
    high = np.tile(HIGH, (n, 1))
    return spaces.Dict({
        "ego": spaces.Box(-1, 1, (D2,), np.float32),
        "vehicles": spaces.Box(-high, high, (n, D1), np.float32),
        "mask": spaces.MultiBinary(n),
        **parts,
    })  # fmt: skip


class Traffic(gym.Env):
    """0 to N random vehicles, five steps long; actions do nothing."""

    observation_space: Any

    def __init__(self, continuous: bool = False, n: int = N, **parts: spaces.Space) -> None:
        self.observation_space = space(n, **parts)
        box = spaces.Box(-1, 1, (1,), np.float32)
        self.action_space = box if continuous else spaces.Discrete(2)

    def _observe(self) -> dict:
        n = self.observation_space["mask"].n
        mask = (np.arange(n) < self.np_random.integers(n + 1)).astype(np.int8)
        vehicles = self.observation_space["vehicles"].sample() * mask[:, None]
        return {"ego": self.observation_space["ego"].sample(), "vehicles": vehicles, "mask": mask}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._observe(), {}

    def step(self, action):
        self.steps += 1
        return self._observe(), float(self.np_random.random()), False, self.steps >= 5, {}
