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
        of_goal = self.env.env_method(  # type: ignore[union-attr]
            "compute_reward",
            self.next_observations["achieved_goal"][batch_indices, env_indices],
            self.observations["desired_goal"][batch_indices, env_indices],
            [{}] * len(batch_indices), indices=[0],
        )[0].astype(np.float32)  # fmt: skip
        other = self.rewards[batch_indices, env_indices] - of_goal
        return found._replace(rewards=found.rewards + self.to_torch(other[:, None]))
