"""What each highway-env environment implies for its observation: one row per environment class.

A subclass inherits the row of its nearest listed ancestor, so users' own variants work too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from typing import Any

from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.exit_env import ExitEnv
from highway_env.envs.highway_env import HighwayEnv
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.envs.lane_keeping_env import LaneKeepingEnv
from highway_env.envs.merge_env import MergeEnv, MergeGenericEnv
from highway_env.envs.parking_env import ParkingEnv
from highway_env.envs.racetrack_env import RacetrackEnv, RacetrackEnvOval
from highway_env.envs.roundabout_env import RoundaboutEnv, RoundaboutGenericEnv
from highway_env.envs.two_way_env import TwoWayEnv
from highway_env.envs.u_turn_env import UTurnEnv

from esc_gym.features import DEFAULT_EGO_FEATURES, Frame

ROUTE = ("dest_x", "dest_y")
DYNAMICS = ("lateral_speed", "yaw_rate")
_STEER = (
    "speed", "lat_off", "cos_lane", "sin_lane", "lanes_left", "lanes_right", "speed_limit",
    *DYNAMICS,
)  # fmt: skip
_LANE_CHANGE_REWARD = "its reward compares the action with the meta-actions 0 and 2"
_TARGET_SPEED_REWARD = "its reward reads the target speeds of a meta-action vehicle"


@dataclass(frozen=True)
class Scenario:
    """Facts of one environment class, read off highway-env 1.12.1.

    capacity(config): the most vehicles and solid obstacles that can be on the road at once, the
    ego excluded; the default N (``max_vehicles``), with which overflow cannot happen.
    discrete_only: why ContinuousAction crashes in highway-env here; None where it works.
    """

    capacity: Callable[[dict[str, Any]], int]
    frame: Frame = "world"
    ego_features: tuple[str, ...] = DEFAULT_EGO_FEATURES
    discrete_only: str | None = None


def _intersection_capacity(config: dict[str, Any]) -> int:
    # IntersectionEnv.step spawns at most one vehicle a step, until `duration` truncates.
    return config["initial_vehicle_count"] + ceil(config["duration"] * config["policy_frequency"])


def _oval_capacity(config: dict[str, Any]) -> int:
    roadblocks = 8 * config["block_lane"] + 4 * config["force_decision"]
    return config["other_vehicles"] + roadblocks


SCENARIOS: dict[type[AbstractEnv], Scenario] = {
    HighwayEnv: Scenario(lambda c: c["vehicles_count"]),
    ExitEnv: Scenario(
        lambda c: c["vehicles_count"], ego_features=(*DEFAULT_EGO_FEATURES, "exit_x", "exit_y")
    ),
    IntersectionEnv: Scenario(
        _intersection_capacity, "ego", (*DEFAULT_EGO_FEATURES, *ROUTE, *DYNAMICS)
    ),
    LaneKeepingEnv: Scenario(
        lambda c: 0, "ego", ("speed", "ref_lat_off", "ref_cos", "ref_sin", *DYNAMICS)
    ),
    MergeEnv: Scenario(lambda c: 4 + 1, discrete_only=_LANE_CHANGE_REWARD),
    MergeGenericEnv: Scenario(
        lambda c: c["vehicles_count"] + 1 + 1, discrete_only=_LANE_CHANGE_REWARD
    ),
    ParkingEnv: Scenario(
        lambda c: c["vehicles_count"] + 4 * bool(c["add_walls"]),
        "ego",
        ("speed", "goal_x", "goal_y", "goal_cos_h", "goal_sin_h", *DYNAMICS),
    ),
    RacetrackEnv: Scenario(lambda c: c["other_vehicles"], "ego", _STEER),
    RacetrackEnvOval: Scenario(_oval_capacity, "ego", _STEER),
    RoundaboutEnv: Scenario(
        lambda c: 4, "ego", (*DEFAULT_EGO_FEATURES, *ROUTE), _LANE_CHANGE_REWARD
    ),
    RoundaboutGenericEnv: Scenario(
        lambda c: c["vehicles_count"], "ego", (*DEFAULT_EGO_FEATURES, *ROUTE), _LANE_CHANGE_REWARD
    ),
    TwoWayEnv: Scenario(lambda c: 5, discrete_only=_TARGET_SPEED_REWARD),
    UTurnEnv: Scenario(lambda c: 6, "ego", (*DEFAULT_EGO_FEATURES, *ROUTE)),
}


def scenario_of_class(env_class: type) -> Scenario | None:
    """The row of ``SCENARIOS`` for a class or its nearest listed ancestor."""
    return next((SCENARIOS[cls] for cls in env_class.__mro__ if cls in SCENARIOS), None)


def scenario_of(env: Any) -> Scenario:
    """The row for ``env``; one that derives from none counts the objects on its road now."""
    count = len(env.road.vehicles) - 1 + sum(o.solid for o in env.road.objects)
    return scenario_of_class(type(env)) or Scenario(lambda config: count)
