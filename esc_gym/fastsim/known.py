"""Which classes the kernels know: those of highway-env whose code they were written after.

A subclass is known too as long as it overrides nothing that the kernels compute; a highway-env
whose simulation code reads differently is not known at all.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Iterable
from functools import cache
from operator import itemgetter
from typing import Any

from highway_env import utils
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import DiscreteMetaAction
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
    "follow_road", "steering_control", "speed_control", "speed_to_index", "index_to_speed",
    "acceleration", "desired_gap",
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
SOURCE = "8562810bca68749f8f673d2c4f8ca3ac3ac4d560acd335668fe5baf460fb6353"


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


_FUNCTIONS = (
    "wrap_to_pi", "not_zero", "do_every", "rotated_rectangles_intersect", "has_corner_inside",
    "point_in_rotated_rectangle", "point_in_rectangle", "rect_corners",
    "are_polygons_intersecting", "project_polygon", "interval_distance",
)  # fmt: skip
# Every name, of a class or module, whose effect the kernels repeat.
_REPEATED: list[tuple[Any, Iterable[str]]] = [
    (AbstractEnv, ["_simulate"]), (IntersectionEnv, ["_make_vehicles"]),
    (DiscreteMetaAction, ["act"]),
    (dynamics, ["rk4"]), (utils, _FUNCTIONS),
    *((cls, sorted(BEHAVIOUR)) for cls in (*VEHICLES, *OBJECTS, RoadObject)),
    *((cls, sorted(GEOMETRY)) for cls in (*LANES, AbstractLane)),
    *((cls, sorted(RULES)) for cls in ROADS),
    (RoadNetwork, sorted(NETWORK)),
    (LinearSpline2D, ["_get_idx_segment_for_lon", "cartesian_to_frenet", "get_dx_dy"]),
    (CurvePose, ["__init__", "project_onto_normal", "project_onto_orthonormal"]),
]  # fmt: skip
_NAMESPACES = [(vars(owner), names) for owner, names in _REPEATED]
_DEFINED = [(n, [name for name in names if name in n]) for n, names in _NAMESPACES]
_UNDEFINED = [(n, [name for name in names if name not in n]) for n, names in _NAMESPACES]
_GETTERS = [(itemgetter(*names), namespace) for namespace, names in _DEFINED if names]
_SPACES = [namespace for namespace, _ in _NAMESPACES]


def _found() -> list[Any]:
    return [get(namespace) for get, namespace in _GETTERS]


def _sizes() -> list[int]:
    return list(map(len, _SPACES))


_FOUND, _SIZES = _found(), _sizes()


def patched() -> bool:
    """Was code that the kernels repeat replaced, or overridden, since this module was imported?"""
    try:
        if _found() != _FOUND:
            return True
    except KeyError:
        return True
    grown = _sizes() != _SIZES
    return grown and any(name in namespace for namespace, names in _UNDEFINED for name in names)


def source_digest() -> str:
    """What identifies the code that the kernels repeat, comments and all.

    Raises OSError where Python cannot find the source.
    """
    digest = hashlib.sha256()
    for value in (namespace[name] for namespace, names in _DEFINED for name in names):
        function: Any = value.fget if isinstance(value, property) else value
        if callable(function) or isinstance(function, staticmethod):
            digest.update(inspect.getsource(getattr(function, "__func__", function)).encode())
    return digest.hexdigest()


class Repeated:
    """Code of highway-env that a part of the batch engine repeats.

    digest: of its source, in highway-env 1.12.1. parts: (class or module, "names of functions").
    """

    def __init__(self, digest: str, *parts: tuple[Any, str]) -> None:
        self._digest = digest
        self._names = [(vars(owner), name) for owner, names in parts for name in names.split()]
        self._functions = self._found()

    def _found(self) -> list[Any]:
        return [namespace.get(name) for namespace, name in self._names]

    def digest(self) -> str:
        """Of the source as it is. Raises OSError where Python cannot find it."""
        digest = hashlib.sha256()
        for function in self._functions:
            function = getattr(function, "fget", getattr(function, "__func__", function))
            digest.update(inspect.getsource(function).encode())
        return digest.hexdigest()

    def differs(self) -> bool:
        """Is the code another than that which is repeated, by its release or by a patch?"""
        try:
            return self._found() != self._functions or self.digest() != self._digest
        except OSError:
            return True
