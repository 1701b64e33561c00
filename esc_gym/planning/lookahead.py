"""Exhaustive look-ahead."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from esc_gym.planning.planner import MetaPlanner, Scenes
from esc_gym.planning.rollouts import meta_actions
from esc_gym.vector.environment import SetVectorEnv


@dataclass(frozen=True, kw_only=True)
class LookAhead(MetaPlanner):
    """All first actions, then one of a few continuations to the horizon.

    free: in how many steps, from the first on, every action is tried. The best of what begins with
    an action says what that is worth.

    Raises ValueError for free below 1 or above the horizon.
    """

    free: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        self._at_least_1("free")
        if self.free > self.horizon:
            raise ValueError(f"free: expected at most the horizon, {self.horizon}, got {self.free}")

    def sequences(self, envs: SetVectorEnv) -> NDArray[np.int64]:
        """What is tried: [A, A**(free - 1) * C, horizon], for A actions and C continuations."""
        count, after = len(meta_actions(envs)), self.ways_on(envs)
        tried = [*product(*[range(count)] * self.free, after)]
        plans = np.repeat(tried, [*[1] * self.free, self.horizon - self.free], axis=1)
        return plans.reshape(count, -1, self.horizon)

    def values(self, envs: SetVectorEnv, indices: Sequence[int] | NDArray | None = None) -> NDArray:
        plans, scenes = self.sequences(envs), Scenes(self, envs, indices)
        count = len(scenes.places)
        everywhere = np.broadcast_to(
            plans.reshape(1, -1, self.horizon), (count, plans[..., 0].size, self.horizon)
        )
        # What is done next has to be chosen before it is known which of the futures comes.
        returns = scenes.returns(np.arange(count), everywhere, self.policy)
        return returns.reshape(count, *plans.shape[:2]).max(axis=2)
