"""highway-env's own driver in the ego's place."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from highway_env.envs.parking_env import ParkingEnv
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.dynamics import BicycleVehicle

from esc_agents.errors import UserError

RULE = "IDM/MOBIL"


class Driver(IDMVehicle):
    """IDM and MOBIL, and what rewards read of an ego that takes meta-actions."""

    target_speeds: np.ndarray  # of the ego's meta-actions [m/s]; continuous actions have none

    @property
    def speed_index(self) -> int:
        """Number of the target speed nearest to its own, as no meta-action chose one."""
        return int(np.abs(self.target_speeds - self.speed).argmin())


class SlippingDriver(Driver, BicycleVehicle):  # type: ignore[override]
    """The same, in the body of an ego with dynamics."""


class RuleDriver(gym.Wrapper):
    """Hands the ego over to highway-env's own driver, IDM and MOBIL, whatever actions are given.

    It wants the highest speed that the ego's meta-actions have, or the lane's limit.

    Raises UserError where there are no lanes to follow.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        if isinstance(env.unwrapped, ParkingEnv):
            raise UserError("expected lanes to follow, got a parking lot")

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        observation, info = self.env.reset(seed=seed, options=options)
        base: Any = self.unwrapped
        ego, vehicles = base.vehicle, base.road.vehicles
        speeds = getattr(ego, "target_speeds", (ego.MAX_SPEED,))
        kept: Any = {name: getattr(ego, name, None) for name in ("target_lane_index", "route")}
        body = SlippingDriver if isinstance(ego, BicycleVehicle) else Driver
        driver = body(
            base.road, ego.position, ego.heading, ego.speed, target_speed=float(speeds[-1]), **kept
        )
        if isinstance(ego, MDPVehicle):
            driver.target_speeds = ego.target_speeds
        vehicles[vehicles.index(ego)] = driver
        base.vehicle = base.action_type.controlled_vehicle = driver
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """``action`` is replaced by the neutral one: some rewards look at it."""
        space: Any = self.action_space
        base: Any = self.unwrapped
        if isinstance(space, gym.spaces.Discrete):
            # Actions without names are a grid of throttles and steerings, neutral in its middle.
            names = getattr(base.action_type, "actions_indexes", {})
            neutral: Any = names.get("IDLE", int(space.n) // 2)
        else:
            neutral = np.zeros(space.shape, space.dtype)
        return self.env.step(neutral)
