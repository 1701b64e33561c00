"""Which environments the batch engine knows, and what of highway-env it repeats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from highway_env import utils
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import ContinuousAction, DiscreteAction, DiscreteMetaAction
from highway_env.vehicle.behavior import (
    AggressiveVehicle,
    DefensiveVehicle,
    IDMVehicle,
    LinearVehicle,
)
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject

from esc_gym import fastsim
from esc_gym.fastsim import known
from esc_gym.fastsim.engine import machine
from esc_gym.vector import observe
from esc_gym.vector.actions import Actions
from esc_gym.vector.scenes import (
    exits,
    highway,
    intersection,
    lane_keeping,
    merge,
    parking,
    racetrack,
    roundabout,
    two_way,
    u_turn,
)

FAMILIES = (
    highway, exits, merge, roundabout, two_way, u_turn, intersection, racetrack, parking,
    lane_keeping,
)  # fmt: skip
DRIVERS = (IDMVehicle, LinearVehicle, AggressiveVehicle, DefensiveVehicle)
# What of highway-env all families repeat, besides the sub-steps.
REPEATED = known.Repeated(
    "7ce9444fbf2486dd1434eaba5cbf2c52fcb71b325ce30cef79e6edc9c6b4ce88",
    (AbstractEnv, "step reset _info vehicle"),
    (utils, "lmap near_split"),
    (ContinuousAction, "get_action act"),
    (DiscreteAction, "act"),
    (RoadObject, "__init__ on_road"),
    (Vehicle, "__init__ create_random"),
    (ControlledVehicle, "__init__"),
    (MDPVehicle, "__init__"),
    (IDMVehicle, "__init__ randomize_behavior"),
    (LinearVehicle, "__init__ randomize_behavior"),
)


@dataclass(frozen=True)
class Report:
    """How a batch is simulated.

    engine: in the batch engine. reason: why not, "" if it is. environments: of the environments
    one by one, where they are not in the engine.
    """

    engine: bool
    reason: str
    environments: tuple[fastsim.Report, ...] = ()

    def __str__(self) -> str:
        if self.engine:
            return "all environments in the batch engine"
        lines = [f"environment {i}: {report}" for i, report in enumerate(self.environments)]
        return "\n".join([f"each environment on its own: {self.reason}", *lines])


def family_of(base: Any) -> tuple[Any, str]:
    """(family, "") of a highway-env environment, or (None, why the engine does not know it)."""
    if problem := machine()[2]:
        return None, problem
    family = next((family for family in FAMILIES if type(base) in family.CLASSES), None)
    if family is None:
        return None, f"scenario {type(base).__name__}"
    if known.patched() or any(code.differs() for code in (REPEATED, family.REPEATED)):
        return None, "code of highway-env was replaced"
    driver = utils.class_from_path(base.config["other_vehicles_type"])
    if driver not in DRIVERS:
        return None, f"traffic of {driver.__name__}"
    if base.config["manual_control"] or base.config["show_trajectories"]:
        return None, "manual control, or trajectories that are shown"
    if base.config["simulation_frequency"] < base.config["policy_frequency"]:
        return None, "policy steps that are shorter than sub-steps"
    if getattr(family, "META_ONLY", False) and not isinstance(base.action_type, DiscreteMetaAction):
        return None, "actions that are no meta-actions"
    weights = [base.config.get(name, 0) for name in family.REWARDS]
    if not all(isinstance(x, int | float) and not isinstance(x, np.generic) for x in weights):
        return None, "weights of rewards that are not Python's numbers"
    if capacity_of(family, base) > 1 and len(base.road.vehicles) < 2:
        return None, "no traffic to read the drivers off"
    reason = (
        Actions.unknown(base.action_type)
        or observe.unknown(base.observation_type)
        or family.unknown(base)
    )
    return (None, reason) if reason else (family, "")


def capacity_of(family: Any, base: Any) -> int:
    """The most vehicles that there can be on the road."""
    count = getattr(family, "capacity", None)
    return count(base) if count else len(base.road.vehicles)
