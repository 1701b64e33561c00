"""Which attributes of a vehicle its record holds, and whether a step's own are still there."""

from __future__ import annotations

from functools import cache, lru_cache
from operator import attrgetter, itemgetter
from typing import Any

from esc_gym.fastsim.network import Unknown
from esc_gym.fastsim.records import (
    BICYCLE,
    CONTROLLED,
    IDM,
    LANDMARK,
    LARGEST,
    LARGEST_DELTA,
    LINEAR,
    MDP,
    OBSTACLE,
    PLAIN,
    TRAIT_FLOATS,
    TRAIT_INTS,
)

ACC_MAX = TRAIT_FLOATS.index("acc_max")  # comfort_max and comfort_min follow
DELTA = TRAIT_FLOATS.index("delta")
DRIVERS = (CONTROLLED, MDP, IDM)
NO_ROUTE: list[Any] = []

# Trait of the record: attribute of the vehicle, for the kinds that have it.
_BODY = {
    "length": "LENGTH", "width": "WIDTH", "diagonal": "diagonal",
    "solid": "solid", "collidable": "collidable", "checks_collisions": "check_collisions",
}  # fmt: skip
_VEHICLE = {
    **_BODY, "max_speed": "MAX_SPEED", "min_speed": "MIN_SPEED", "coasts": "prediction_type",
}  # fmt: skip
_CONTROLLED = {
    **_VEHICLE, "kp_acceleration": "KP_A", "kp_heading": "KP_HEADING", "kp_lateral": "KP_LATERAL",
    "tau_pursuit": "TAU_PURSUIT", "max_steering": "MAX_STEERING_ANGLE",
}  # fmt: skip
_IDM = {
    **_CONTROLLED, "acc_max": "ACC_MAX", "comfort_max": "COMFORT_ACC_MAX",
    "comfort_min": "COMFORT_ACC_MIN", "distance_wanted": "DISTANCE_WANTED",
    "time_wanted": "TIME_WANTED", "delta": "DELTA", "politeness": "POLITENESS",
    "min_gain": "LANE_CHANGE_MIN_ACC_GAIN", "max_braking": "LANE_CHANGE_MAX_BRAKING_IMPOSED",
    "lane_change_delay": "LANE_CHANGE_DELAY", "changes_lanes": "enable_lane_change",
}  # fmt: skip
_BICYCLE = {
    **_VEHICLE, "mass": "MASS", "length_a": "LENGTH_A", "length_b": "LENGTH_B",
    "inertia": "INERTIA_Z", "friction_front": "FRICTION_FRONT",
    "friction_rear": "FRICTION_REAR", "max_yaw_rate": "MAX_ANGULAR_SPEED",
}  # fmt: skip
_LINEAR = {**_IDM, "collects": "collecting_data"}
_COEFFICIENTS = (
    "acceleration_0", "acceleration_1", "acceleration_2", "steering_0", "steering_1"
)  # fmt: skip
TRAITS_OF = {
    PLAIN: _VEHICLE, BICYCLE: _BICYCLE, CONTROLLED: _CONTROLLED, MDP: _CONTROLLED, IDM: _IDM,
    LINEAR: _LINEAR, OBSTACLE: _BODY, LANDMARK: _BODY,
}  # fmt: skip
READ = {kind: attrgetter(*traits.values()) for kind, traits in TRAITS_OF.items()}
# What else of a driver's own attributes says that its record is still right.
_PLACE = (
    "road", "lane_index", "lane", "target_lane_index", "crashed", "hit",
    "is_yielding", "yield_timer",
)  # fmt: skip


def _arranger(kind: int) -> Any:
    """Picks the traits of a record, in its order, from (*attributes, kind, 0)."""
    names = list(TRAITS_OF[kind]) + list(_COEFFICIENTS if kind == LINEAR else ())
    places = {name: place for place, name in enumerate([*names, "kind"])}
    return itemgetter(*[places.get(name, -1) for name in TRAIT_FLOATS + TRAIT_INTS])


_ARRANGE = {kind: _arranger(kind) for kind in TRAITS_OF}


def trait_record(kind: int, found: tuple[Any, ...]) -> tuple[Any, ...]:
    """What is packed into a record for the attributes of a vehicle or object."""
    values = _ARRANGE[kind]((*found, kind, 0))
    floats, flags = values[: len(TRAIT_FLOATS)], values[len(TRAIT_FLOATS) + 1 : -1]
    if not sum(map(abs, floats)) < LARGEST or not 0 <= floats[DELTA] <= LARGEST_DELTA:
        raise Unknown("a vehicle with NaN, infinite or enormous parameters")
    if kind in (IDM, LINEAR):
        _, comfort_max, comfort_min = floats[ACC_MAX : ACC_MAX + 3]
        if not comfort_max * comfort_min < 0:
            raise Unknown("an IDM vehicle whose comfort accelerations have the same sign")
    return *floats, kind, *map(bool, flags), values[-1] == "zero_steering"


@lru_cache(1000)
def _own_reader(kind: int, attributes: tuple[str, ...]) -> Any:
    """Reads what a vehicle has itself of its record, but for what every step writes."""
    return itemgetter(
        *[name for name in (*_PLACE, *TRAITS_OF[kind].values()) if name in attributes]
    )


class Driver:
    """What the last step left in a controlled vehicle: unless it was touched, its record is right.

    Numbers that the step wrote are compared by identity, which 0.0 and -0.0 do not share.
    """

    __slots__ = (
        "found", "heading", "place", "read", "route", "size", "speed", "target_speed", "timer",
    )  # fmt: skip

    def __init__(self) -> None:
        self.size = -1

    def learn(self, vehicle: Any, kind: int, route: list[Any]) -> None:
        """Note what a step does not change without saying so."""
        d = vehicle.__dict__
        self.read = _own_reader(kind, tuple(d))
        self.size, self.found, self.route = len(d), self.read(d), route
        self.target_speed = d["target_speed"]

    def untouched(self, d: dict[str, Any]) -> bool:
        """Are a vehicle's attributes those that the step left?"""
        return (
            len(d) == self.size
            and d["heading"] is self.heading
            and d["speed"] is self.speed
            and d["target_speed"] is self.target_speed
            and d.get("timer") is self.timer
            and d["position"].tobytes() == self.place
            and d["impact"] is None
            and (d["route"] or NO_ROUTE) == self.route
            and self.read(d) == self.found
        )


@cache
def class_traits(cls: type, kind: int) -> Any:
    """Reads those traits that a class has for its vehicles."""
    return attrgetter(*[name for name in TRAITS_OF[kind].values() if hasattr(cls, name)])
