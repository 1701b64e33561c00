"""Stable-Baselines3's hindsight experience replay, for goals of which not everything depends."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3 import HerReplayBuffer


class HindsightBuffer(HerReplayBuffer):
    """HER (Andrychowicz et al., 2017) in which a collision costs what it costs, whatever the goal.

    Rewards of other goals are ``compute_reward``'s, which in parking knows of no collision. Without
    its cost, a crash would only be the end of all steps that are still far from the goal: what one
    learns from other goals would be to crash soon.
    """

    def _get_virtual_samples(
        self, batch_indices: np.ndarray, env_indices: np.ndarray, env: Any = None
    ) -> Any:
        found = super()._get_virtual_samples(batch_indices, env_indices, env)
        rewards = found.rewards.clone()
        ended = np.flatnonzero(self.dones[batch_indices, env_indices])
        if len(ended):
            where = batch_indices[ended], env_indices[ended]
            (of_goal,) = self.env.env_method(  # type: ignore[union-attr]
                "compute_reward", self.next_observations["achieved_goal"][where],
                self.observations["desired_goal"][where], [{}] * len(ended), indices=[0],
            )  # fmt: skip
            other = self.rewards[where] - of_goal.astype(np.float32)
            rewards[ended, 0] += self.to_torch(other)
        return found._replace(rewards=rewards)
