"""Which classes the kernels know: those of highway-env whose code they were written after.

A subclass is known too as long as it overrides nothing that the kernels compute; a highway-env
whose simulation code reads differently is not known at all.
"""

from __future__ import annotations

import hashlib
import inspect
from functools import cache
from typing import Any

from highway_env import utils
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.road.lane import (
    AbstractLane,
    CircularLane,
    PolyLane,
    PolyLaneFixedWidth,
    SineLane,
    StraightLane,
)
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, RoadNetwork
from highway_env.road.spline import CurvePose, LinearSpline2D
from highway_env.vehicle import dynamics
from highway_env.vehicle.behavior import IDMVehicle, LinearVehicle
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.dynamics import BicycleVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, Obstacle, RoadObject

from esc_gym.fastsim import records

# Most derived first.
VEHICLES = {
    LinearVehicle: records.LINEAR,
    IDMVehicle: records.IDM,
    MDPVehicle: records.MDP,
    ControlledVehicle: records.CONTROLLED,
    BicycleVehicle: records.BICYCLE,
    Vehicle: records.PLAIN,
}
OBJECTS = {Obstacle: records.OBSTACLE, Landmark: records.LANDMARK}
LANES = {
    PolyLane: records.SPLINE,
    PolyLaneFixedWidth: records.SPLINE,
    CircularLane: records.CIRCULAR,
    SineLane: records.SINE,
    StraightLane: records.STRAIGHT,
}
ROADS = {RegulatedRoad: True, Road: False}

# What the kernels replace; each class has some of these.
BEHAVIOUR = {
    "act", "step", "clip_actions", "on_state_update", "predict_trajectory_constant_speed",
    "follow_road", "steering_control", "speed_control", "acceleration", "desired_gap",
    "change_lane_policy", "mobil", "collect_data", "add_features", "acceleration_features",
    "steering_features", "state", "derivative_func",
    "handle_collisions", "_is_colliding", "polygon", "direction", "velocity", "lane_distance_to",
    "front_distance_to", "__bool__", "__len__", "__getattr__", "__getattribute__", "__setattr__",
}  # fmt: skip
GEOMETRY = {
    "position", "local_coordinates", "heading_at", "width_at", "on_lane", "is_reachable_from",
    "after_end", "distance", "distance_with_heading", "local_angle", "VEHICLE_LENGTH",
}  # fmt: skip
RULES = {
    "act", "step", "neighbour_vehicles", "enforce_road_rules", "respect_priorities",
    "is_conflict_possible",
}  # fmt: skip
NETWORK = {"get_lane", "get_closest_lane_index", "side_lanes", "position_heading_along_route"}

# sha256 of the source that the kernels repeat, of highway-env 1.12.1.
SOURCE = "6599bcb6fa5d312a92476aa526c61c7677613b4d2c4e0ef19cc86c09b5a31bab"


def _kind(cls: type, known: dict[Any, Any], names: set[str]) -> Any:
    """The entry of the nearest known ancestor of ``cls`` if it overrides none of ``names``."""
    base = next((base for base in known if issubclass(cls, base)), None)
    if base is None:
        return None
    missing = object()
    for name in names:
        mine = inspect.getattr_static(cls, name, missing)
        if mine is not inspect.getattr_static(base, name, missing):
            return None
    return known[base]


@cache
def vehicle_kind(cls: type) -> int | None:
    """The record kind of a vehicle class; None if the kernels do not know it."""
    return _kind(cls, VEHICLES, BEHAVIOUR)


@cache
def object_kind(cls: type) -> int | None:
    """The record kind of an obstacle's or landmark's class."""
    return _kind(cls, OBJECTS, BEHAVIOUR)


@cache
def lane_kind(cls: type) -> int | None:
    """The record kind of a lane class."""
    return _kind(cls, LANES, GEOMETRY)


@cache
def is_regulated(cls: type) -> bool | None:
    """Does a road class have road rules? None if the kernels do not know it."""
    return _kind(cls, ROADS, RULES)


@cache
def is_known_network(cls: type) -> bool | None:
    return _kind(cls, {RoadNetwork: True}, NETWORK)


def _replaced() -> list[Any]:
    """Every function whose effect the kernels repeat."""
    functions: list[Any] = [
        AbstractEnv._simulate, IntersectionEnv._make_vehicles, dynamics.rk4,
        utils.wrap_to_pi, utils.not_zero, utils.do_every, utils.rotated_rectangles_intersect,
        utils.has_corner_inside, utils.point_in_rotated_rectangle, utils.point_in_rectangle,
        utils.rect_corners, utils.are_polygons_intersecting, utils.project_polygon,
        utils.interval_distance,
    ]  # fmt: skip
    tables: list[tuple[list[Any], set[str]]] = [
        ([*VEHICLES, *OBJECTS, RoadObject], BEHAVIOUR),
        ([*LANES, AbstractLane], GEOMETRY),
        ([*ROADS], RULES),
        ([RoadNetwork], NETWORK),
        ([LinearSpline2D], {"cartesian_to_frenet", "get_dx_dy", "_get_idx_segment_for_lon"}),
        ([CurvePose], {"__init__", "project_onto_normal", "project_onto_orthonormal"}),
    ]
    for classes, names in tables:
        for cls in classes:
            functions += [vars(cls)[name] for name in sorted(names & vars(cls).keys())]
    return functions


def source_digest() -> str:
    """What identifies the code that the kernels repeat, comments and all."""
    digest = hashlib.sha256()
    for function in _replaced():
        if isinstance(function, property):
            function = function.fget
        if callable(function) or isinstance(function, staticmethod | classmethod):
            digest.update(inspect.getsource(getattr(function, "__func__", function)).encode())
    return digest.hexdigest()
