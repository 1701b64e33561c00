"""highway-env's parking environments, with the goal interface only where it is asked for.

The set observation has the goal in ``ego``, or with ``SetObservation(goal=True)`` in the keys
``achieved_goal`` and ``desired_goal``. An environment without them that still had
``compute_reward`` would be taken for a goal environment (by HER, by SB3 ``check_env``) and fail
there. Rewards are the same to the last bit, computed without pandas.
"""

from __future__ import annotations

from functools import partial
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


class _SetParking(ParkingEnv):
    @property
    def compute_reward(self) -> Any:  # type: ignore[override]
        """``ParkingEnv.compute_reward``, of single goals [6] or a batch [B, 6] of them."""
        if "achieved_goal" in getattr(self.observation_space, "spaces", {}):
            return partial(_reward_of, self)
        raise AttributeError("compute_reward: pass SetObservation(goal=True) for the goal's keys")

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


def _reward_of(
    env: ParkingEnv, achieved: NDArray, desired: NDArray, info: Any, p: float = 0.5
) -> Any:
    """Of each pair of a batch what it would be alone: one product for all rounds otherwise."""
    if achieved.ndim == 1:
        return ParkingEnv.compute_reward(env, achieved, desired, info, p)
    pairs = zip(achieved, desired, strict=True)
    return np.array([ParkingEnv.compute_reward(env, one, other, {}, p) for one, other in pairs])


class SetParkingEnv(_SetParking):
    """parking-v0."""


class SetParkingEnvActionRepeat(_SetParking, ParkingEnvActionRepeat):
    """parking-ActionRepeat-v0."""


class SetParkingEnvParkedVehicles(_SetParking, ParkingEnvParkedVehicles):
    """parking-parked-v0."""


SET_PARKING: dict[type, type] = {
    ParkingEnv: SetParkingEnv,
    ParkingEnvActionRepeat: SetParkingEnvActionRepeat,
    ParkingEnvParkedVehicles: SetParkingEnvParkedVehicles,
}
