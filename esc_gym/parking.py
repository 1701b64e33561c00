"""highway-env's parking environments without their goal interface.

With the set as observation, the goal stands in ``ego`` and there are no ``desired_goal`` keys. An
environment that still had ``compute_reward`` would be taken for a goal environment (by HER, by SB3
``check_env``) and fail there. Rewards are the same to the last bit, computed without pandas.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from highway_env.envs.common.observation import KinematicsGoalObservation
from highway_env.envs.parking_env import (
    ParkingEnv,
    ParkingEnvActionRepeat,
    ParkingEnvParkedVehicles,
)
from numpy.typing import NDArray


class GoalObservation(KinematicsGoalObservation):
    """The stock observation that parking is rewarded by, without its two pandas frames."""

    def observe(self) -> dict[str, NDArray]:
        if not self.observer_vehicle:
            return super().observe()
        vehicle: Any = self.observer_vehicle
        state, goal = vehicle.to_dict(), vehicle.goal.to_dict()
        achieved = np.array([state[name] for name in self.features]) / self.scales
        desired = np.array([goal[name] for name in self.features]) / self.scales
        return {"observation": achieved, "achieved_goal": achieved, "desired_goal": desired}


class _WithoutGoalKeys(ParkingEnv):
    @property
    def compute_reward(self) -> Any:  # type: ignore[override]
        raise AttributeError("compute_reward: the set observation has no goal keys")

    def define_spaces(self) -> None:
        super().define_spaces()
        arguments = {k: v for k, v in self.PARKING_OBS["observation"].items() if k != "type"}
        self.observation_type_parking = GoalObservation(self, **arguments)

    def _reward(self, action: Any) -> float:
        goal = self.observation_type_parking.observe()
        reward = ParkingEnv.compute_reward(self, goal["achieved_goal"], goal["desired_goal"], {})
        return reward + self.config["collision_reward"] * self.vehicle.crashed

    def _is_success(self, achieved_goal: NDArray, desired_goal: NDArray) -> bool:
        reward = ParkingEnv.compute_reward(self, achieved_goal, desired_goal, {})
        return reward > -self.config["success_goal_reward"]


class SetParkingEnv(_WithoutGoalKeys):
    """parking-v0."""


class SetParkingEnvActionRepeat(_WithoutGoalKeys, ParkingEnvActionRepeat):
    """parking-ActionRepeat-v0."""


class SetParkingEnvParkedVehicles(_WithoutGoalKeys, ParkingEnvParkedVehicles):
    """parking-parked-v0."""


WITHOUT_GOAL_KEYS: dict[type, type] = {
    ParkingEnv: SetParkingEnv,
    ParkingEnvActionRepeat: SetParkingEnvActionRepeat,
    ParkingEnvParkedVehicles: SetParkingEnvParkedVehicles,
}
