"""What is observed: the tables of vehicle features (x_i) and ego features (x_else).

Shapes: every getter returns one float, in the unit of its table row. d1 = number of vehicle
features, d2 = number of ego features. Adding a feature is one row.

Frames: ``"world"`` has highway-env's axes (x forward on straight roads, y to the right, in metres);
``"ego"`` is the body frame of the ego (x along its heading). Positions and velocities of others are
relative to the ego in both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, pi, sin
from typing import Any, Literal

from highway_env.vehicle.kinematics import Vehicle

from esc_gym.measures import time_to

Frame = Literal["world", "ego"]
LANE = 4.0  # AbstractLane.DEFAULT_WIDTH [m]: what "a lane aside" is, on any road


@dataclass(frozen=True)
class Limits:
    """What the simulator can produce: the scale of the tables below.

    distance: perception distance [m]; no observed vehicle is further away.
    speed: fastest speed [m/s], forwards or backwards, overshoot of a sub-step included.
    """

    distance: float
    speed: float

    @classmethod
    def of(cls, config: dict[str, Any], distance: float) -> Limits:
        """Limits under a highway-env configuration (its ``action.speed_range`` may raise them)."""
        speeds = config["action"].get("speed_range") or ()
        # Vehicle.clip_actions brakes only once MAX_SPEED is passed, hence the margin.
        return cls(distance, max(Vehicle.MAX_SPEED, *(abs(s) for s in speeds), 0.0) + 5.0)


class EgoView:
    """The ego vehicle at the instant of an observation: what every getter reads, computed once."""

    __slots__ = (
        "cos", "env", "heading", "lane", "lateral", "longitudinal", "sin", "speed", "vehicle",
        "vx", "vy", "x", "y",
    )  # fmt: skip

    def __init__(self, env: Any, frame: Frame) -> None:
        self.env, self.vehicle = env, env.vehicle
        self.x, self.y = self.vehicle.position.tolist()
        self.heading, self.speed = float(self.vehicle.heading), float(self.vehicle.speed)
        self.vx, self.vy = self.speed * cos(self.heading), self.speed * sin(self.heading)
        self.cos, self.sin = (
            (cos(self.heading), sin(self.heading)) if frame == "ego" else (1.0, 0.0)
        )
        self.lane = self.vehicle.lane
        self.longitudinal, self.lateral = self.lane.local_coordinates(self.vehicle.position)

    def lane_angle(self) -> float:
        """Heading relative to the ego's lane [rad], not wrapped."""
        return self.heading - self.lane.heading_at(self.longitudinal)

    def forward(self, x: float, y: float) -> float:
        """First coordinate, in the frame of the observation, of a world vector."""
        return self.cos * x + self.sin * y

    def right(self, x: float, y: float) -> float:
        """Second coordinate, in the frame of the observation, of a world vector."""
        return self.cos * y - self.sin * x


@dataclass(frozen=True)
class VehicleFeature:
    """One column of ``vehicles``.

    bounds(limits): physical (low, high) of the value; never exceeded within the limits.
    get(ego, other): ``other`` is a highway-env vehicle or obstacle. None for the default features,
    which ``default_row`` computes together, since they share their sines and cosines.
    """

    unit: str
    bounds: Callable[[Limits], tuple[float, float]]
    meaning: str
    get: Callable[[EgoView, Any], float] | None = None


@dataclass(frozen=True)
class EgoFeature:
    """One entry of ``ego``; values beyond the bounds saturate there (an ego far off any road)."""

    unit: str
    bounds: Callable[[Limits], tuple[float, float]]
    get: Callable[[EgoView], float]
    meaning: str


def _symmetric(bound: float) -> Callable[[Limits], tuple[float, float]]:
    return lambda limits: (-bound, bound)


def _upto(bound: float) -> Callable[[Limits], tuple[float, float]]:
    return lambda limits: (0.0, bound)


def _distance(limits: Limits) -> tuple[float, float]:
    return -limits.distance, limits.distance


def _speed(limits: Limits) -> tuple[float, float]:
    return -limits.speed, limits.speed


def _relative_speed(limits: Limits) -> tuple[float, float]:
    return -2 * limits.speed, 2 * limits.speed


def default_row(ego: EgoView, other: Any, dx: float, dy: float) -> tuple[float, ...]:
    """The ``DEFAULT_FEATURES`` of one vehicle or obstacle, in physical units.

    (dx, dy): position of ``other`` minus the ego's, in world axes [m].
    """
    heading, speed = other.heading, other.speed
    c, s = cos(heading), sin(heading)
    vx, vy = speed * c - ego.vx, speed * s - ego.vy
    # Not isinstance: highway-env's objects are ABCs, whose instance check costs more than the row.
    obstacle = 0.0 if hasattr(other, "act") else 1.0
    if ego.sin == 0.0 and ego.cos == 1.0:
        return dx, dy, vx, vy, c, s, obstacle
    return (
        ego.forward(dx, dy), ego.right(dx, dy),
        ego.forward(vx, vy), ego.right(vx, vy),
        ego.forward(c, s), ego.right(c, s),
        obstacle,
    )  # fmt: skip


def _destination(vehicle: Any) -> tuple[float, float]:
    """Unit vector to the end of the route, (0, 0) without a route (Vehicle.to_dict, cos_d)."""
    if not getattr(vehicle, "route", None):
        return 0.0, 0.0
    x, y = vehicle.destination_direction.tolist()
    return x, y


def _relative(ego: EgoView, other: Any) -> tuple[float, float]:
    """Position relative to the ego, in the frame of the observation [m]."""
    x, y = other.position.tolist()
    dx, dy = x - ego.x, y - ego.y
    return ego.forward(dx, dy), ego.right(dx, dy)


def near_along(x: float) -> float:
    """Closeness along: 1 beside the ego, 1/2 at 20 m, 1/5 at 40 m."""
    x = x / 20.0
    return 1.0 / (1.0 + x * x)


def near_across(y: float) -> float:
    """Closeness across: 1 in line with the ego, 1/2 half a lane away (2 m), 1/17 a lane away."""
    y = y / 2.0
    square = y * y
    return 1.0 / (1.0 + square * square)


def _near(ego: EgoView, other: Any, lanes: float, side: float) -> float:
    """Closeness to where the ego is, or so many lanes to the right; ahead (side 1), behind (-1)."""
    x, y = _relative(ego, other)
    if x * side < 0.0:
        return 0.0
    return near_along(x) * near_across(y - LANE * lanes)


def _urgency(ego: EgoView, other: Any, lanes: float = 0.0) -> float:
    """1/(1 + t), t seconds to their collision if both keep their velocities; 0 for never.

    lanes: as if the ego were so many lanes to the right.
    """
    return 1.0 / (1.0 + time_to(ego.vehicle, other, LANE * lanes))


VEHICLE_FEATURES: dict[str, VehicleFeature] = {
    "x": VehicleFeature("m", _distance, "relative position, forward"),
    "y": VehicleFeature("m", _distance, "relative position, to the right"),
    "vx": VehicleFeature("m/s", _relative_speed, "relative velocity, forward"),
    "vy": VehicleFeature("m/s", _relative_speed, "relative velocity, to the right"),
    "cos_h": VehicleFeature("1", _symmetric(1.0), "cosine of the heading in the frame"),
    "sin_h": VehicleFeature("1", _symmetric(1.0), "sine of the heading in the frame"),
    "obstacle": VehicleFeature("1", _symmetric(1.0), "1 for a solid obstacle, 0 for a vehicle"),
    "length": VehicleFeature("m", _upto(100.0), "length", lambda e, o: o.LENGTH),
    "width": VehicleFeature("m", _upto(100.0), "width", lambda e, o: o.WIDTH),
    "cos_d": VehicleFeature("1", _symmetric(1.0),
                            "direction to its destination, forward part; 0 without a route",
                            lambda e, o: e.forward(*_destination(o))),
    "sin_d": VehicleFeature("1", _symmetric(1.0),
                            "direction to its destination, right part; 0 without a route",
                            lambda e, o: e.right(*_destination(o))),
    "near_x": VehicleFeature("1", _upto(1.0), "closeness along: 1 beside the ego, 1/2 at 20 m",
                             lambda e, o: near_along(_relative(e, o)[0])),
    "near_y": VehicleFeature("1", _upto(1.0), "closeness across: 1 in line, 1/2 half a lane away",
                             lambda e, o: near_across(_relative(e, o)[1])),
    "ahead": VehicleFeature("1", _upto(1.0), "closeness in the ego's lane, ahead of it",
                            lambda e, o: _near(e, o, 0, 1.0)),
    "behind": VehicleFeature("1", _upto(1.0), "closeness in the ego's lane, behind it",
                             lambda e, o: _near(e, o, 0, -1.0)),
    "left": VehicleFeature("1", _upto(1.0), "closeness to the place a lane to the ego's left",
                           lambda e, o: _near(e, o, -1, 0.0)),
    "right": VehicleFeature("1", _upto(1.0), "closeness to the place a lane to the ego's right",
                            lambda e, o: _near(e, o, 1, 0.0)),
    "urgency": VehicleFeature("1", _upto(1.0),
                              "1/(1 + t), t seconds to a collision at constant velocities",
                              _urgency),
    "urgency_left": VehicleFeature("1", _upto(1.0), "urgency, were the ego a lane to the left",
                                   lambda e, o: _urgency(e, o, -1.0)),
    "urgency_right": VehicleFeature("1", _upto(1.0), "urgency, were the ego a lane to the right",
                                    lambda e, o: _urgency(e, o, 1.0)),
}  # fmt: skip


def _lanes_to_the_right(ego: EgoView) -> float:
    start, end, lane = ego.vehicle.lane_index
    return len(ego.env.road.network.graph[start][end]) - 1 - lane


def _target_lateral(ego: EgoView) -> float:
    """Lateral offset from the lane that the meta-action controller steers to [m]."""
    vehicle = ego.vehicle
    target = getattr(vehicle, "target_lane_index", None)
    if target is None or target == vehicle.lane_index:
        return ego.lateral
    return vehicle.road.network.get_lane(target).local_coordinates(vehicle.position)[1]


def _to_destination(ego: EgoView) -> tuple[float, float]:
    if not getattr(ego.vehicle, "route", None):
        return 0.0, 0.0
    x, y = ego.vehicle.destination.tolist()
    return x - ego.x, y - ego.y


def _to_goal(ego: EgoView) -> tuple[float, float]:
    x, y = ego.vehicle.goal.position.tolist()
    return x - ego.x, y - ego.y


def _goal_heading(ego: EgoView) -> tuple[float, float]:
    heading = ego.vehicle.goal.heading
    return cos(heading), sin(heading)


def _to_exit(ego: EgoView) -> tuple[float, float]:
    """Coordinates along and across the lane of exit-v0 that leaves the road (ExitObservation)."""
    return ego.env.road.network.get_lane(("1", "2", -1)).local_coordinates(ego.vehicle.position)


def _reference(ego: EgoView) -> tuple[float, float]:
    """(lateral offset [m], angle [rad]) to the lane that LaneKeepingEnv rewards to follow."""
    lane = ego.env.lane
    if lane is None:  # LaneKeepingEnv forgets its lane between __init__ and the first reset.
        return 0.0, 0.0
    longitudinal, lateral = lane.local_coordinates(ego.vehicle.position)
    return lateral, ego.heading - lane.heading_at(longitudinal)


EGO_FEATURES: dict[str, EgoFeature] = {
    "speed": EgoFeature("m/s", _speed, lambda e: e.speed, "speed along the heading"),
    "lat_off": EgoFeature("m", _symmetric(20.0), lambda e: e.lateral, "lateral offset in lane"),
    "cos_lane": EgoFeature("1", _symmetric(1.0), lambda e: cos(e.lane_angle()),
                           "cosine of the heading relative to the lane"),
    "sin_lane": EgoFeature("1", _symmetric(1.0), lambda e: sin(e.lane_angle()),
                           "sine of the heading relative to the lane"),
    "lanes_left": EgoFeature("1", _upto(8.0), lambda e: e.vehicle.lane_index[2],
                             "lanes to the left on this road"),
    "lanes_right": EgoFeature("1", _upto(8.0), _lanes_to_the_right,
                              "lanes to the right on this road"),
    "speed_limit": EgoFeature("m/s", _upto(40.0),
                              lambda e: 40.0 if e.lane.speed_limit is None else e.lane.speed_limit,
                              "speed limit of the lane; 40 where there is none"),
    "target_speed": EgoFeature("m/s", _speed,
                               lambda e: getattr(e.vehicle, "target_speed", e.speed),
                               "speed the meta-action controller tracks; else the speed"),
    "target_lat_off": EgoFeature("m", _symmetric(20.0), _target_lateral,
                                 "lateral offset to the lane the controller tracks"),
    "lateral_speed": EgoFeature("m/s", _symmetric(20.0),
                                lambda e: getattr(e.vehicle, "lateral_speed", 0.0),
                                "slip speed of the dynamical BicycleVehicle, else 0"),
    "yaw_rate": EgoFeature("rad/s", _symmetric(2 * pi),
                           lambda e: getattr(e.vehicle, "yaw_rate", 0.0),
                           "yaw rate of the dynamical BicycleVehicle, else 0"),
    "dest_x": EgoFeature("m", _symmetric(200.0), lambda e: e.forward(*_to_destination(e)),
                         "end of the planned route, forward; 0 without a route"),
    "dest_y": EgoFeature("m", _symmetric(200.0), lambda e: e.right(*_to_destination(e)),
                         "end of the planned route, to the right; 0 without a route"),
    "goal_x": EgoFeature("m", _symmetric(100.0), lambda e: e.forward(*_to_goal(e)),
                         "parking goal, forward"),
    "goal_y": EgoFeature("m", _symmetric(100.0), lambda e: e.right(*_to_goal(e)),
                         "parking goal, to the right"),
    "goal_cos_h": EgoFeature("1", _symmetric(1.0), lambda e: e.forward(*_goal_heading(e)),
                             "cosine of the goal's heading in the frame"),
    "goal_sin_h": EgoFeature("1", _symmetric(1.0), lambda e: e.right(*_goal_heading(e)),
                             "sine of the goal's heading in the frame"),
    "exit_x": EgoFeature("m", _symmetric(500.0), lambda e: _to_exit(e)[0],
                         "way travelled past the start of the exit lane; negative before it"),
    "exit_y": EgoFeature("m", _symmetric(50.0), lambda e: _to_exit(e)[1],
                         "lateral offset to the exit lane"),
    "ref_lat_off": EgoFeature("m", _symmetric(20.0), lambda e: _reference(e)[0],
                              "lateral offset to the reference lane"),
    "ref_cos": EgoFeature("1", _symmetric(1.0), lambda e: cos(_reference(e)[1]),
                          "cosine of the heading relative to the reference lane"),
    "ref_sin": EgoFeature("1", _symmetric(1.0), lambda e: sin(_reference(e)[1]),
                          "sine of the heading relative to the reference lane"),
}  # fmt: skip

DEFAULT_FEATURES = ("x", "y", "vx", "vy", "cos_h", "sin_h", "obstacle")
DEFAULT_EGO_FEATURES = (
    "speed", "lat_off", "cos_lane", "sin_lane", "lanes_left", "lanes_right",
    "speed_limit", "target_speed", "target_lat_off",
)  # fmt: skip
