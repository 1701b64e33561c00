"""highway-env's own driver in the ego's place."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from highway_env.vehicle.behavior import IDMVehicle


class RuleDriver(gym.Wrapper):
    """Hands the ego over to highway-env's own driver, IDM and MOBIL, whatever actions are given.

    It wants the highest speed that the ego's meta-actions have, or the lane's limit.
    """

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        observation, info = self.env.reset(seed=seed, options=options)
        base: Any = self.unwrapped
        ego, vehicles = base.vehicle, base.road.vehicles
        speeds = getattr(ego, "target_speeds", (ego.MAX_SPEED,))
        kept: Any = {name: getattr(ego, name, None) for name in ("target_lane_index", "route")}
        driver = IDMVehicle(
            base.road, ego.position, ego.heading, ego.speed, target_speed=float(speeds[-1]), **kept
        )
        vehicles[vehicles.index(ego)] = driver
        base.vehicle = base.action_type.controlled_vehicle = driver
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """``action`` is replaced by the neutral one: some rewards look at it."""
        space: Any = self.action_space
        base: Any = self.unwrapped
        if isinstance(space, gym.spaces.Discrete):
            neutral: Any = base.action_type.actions_indexes["IDLE"]
        else:
            neutral = np.zeros(space.shape, space.dtype)
        return self.env.step(neutral)
