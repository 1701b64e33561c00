"""How vehicles come onto a road and what rewards read of it: highway-env's code, on records.

``s`` is the Scene of one environment, ``i`` a vehicle, ``k`` a lane, ``g`` a row of generators.
"""

from __future__ import annotations

import sys
from math import sqrt
from typing import Any

import numpy as np
from highway_env.vehicle.controller import ControlledVehicle

from esc_gym.fastsim.geometry import (
    VEHICLE_LENGTH,
    closest_lane,
    heading_at,
    local_coordinates,
    locate,
    position,
    width_at,
)
from esc_gym.fastsim.network import Network
from esc_gym.fastsim.numerics import compiled, dot, outlined
from esc_gym.fastsim.records import CONTROLLED, IDM, LINEAR, NO_LANE
from esc_gym.vector.generators import random, uniform

ROUTE_LENGTH = 16


@compiled
def place(s, i, x, y, heading, speed):
    """A new object: ``RoadObject.__init__``. What it leaves alone is the template's."""
    thing = s.vehicles[i]
    thing.x, thing.y, thing.heading, thing.speed = x, y, heading, speed
    thing.lane = 0
    locate(s, i)
    thing.lane = thing.target_lane = closest_lane(s, i)


@outlined
def create(s, i, x, y, heading, speed):
    """A new vehicle: the constructors of its class."""
    place(s, i, x, y, heading, speed)
    vehicle = s.vehicles[i]
    if vehicle.kind >= IDM:
        vehicle.target_speed = speed
        vehicle.timer = ((x + y) * np.pi) % vehicle.lane_change_delay


@outlined
def make_on_lane(s, i, k, longitudinal, speed):
    """``RoadObject.make_on_lane``."""
    x, y = position(s, k, longitudinal)
    create(s, i, x, y, heading_at(s, k, longitudinal), speed)


@compiled
def furthest(s, k, count):
    """The greatest longitudinal coordinate on lane k of the first ``count`` vehicles."""
    most = -np.inf
    for j in range(count):
        most = max(most, local_coordinates(s, k, s.vehicles[j].x, s.vehicles[j].y)[0])
    return most


@outlined
def create_random(s, i, g, k, speed, spacing, density):
    """``Vehicle.create_random`` on lane k, vehicle i behind none of those before it.

    speed: NaN for any. density: exp(-5 / 40 * lanes), NumPy's.
    """
    limit = s.lanes[k].speed_limit
    if speed != speed:
        speed = uniform(g, 0.7 * limit, 0.8 * limit) if s.lanes[k].limited else uniform(g, 23, 25)
    offset = spacing * (12 + 1.0 * speed) * density
    ahead = furthest(s, k, i) if i > 0 else 3 * offset
    ahead += offset * uniform(g, 0.9, 1.1)
    make_on_lane(s, i, k, ahead, speed)


@outlined
def randomize(s, i, g, ranges):
    """``randomize_behavior``; ranges [6, 2]: see ``behavior_ranges``."""
    driver = s.vehicles[i]
    if driver.kind == LINEAR:
        driver.acceleration_0 = ranges[1, 0] + random(g) * (ranges[1, 1] - ranges[1, 0])
        driver.acceleration_1 = ranges[2, 0] + random(g) * (ranges[2, 1] - ranges[2, 0])
        driver.acceleration_2 = ranges[3, 0] + random(g) * (ranges[3, 1] - ranges[3, 0])
        driver.steering_0 = ranges[4, 0] + random(g) * (ranges[4, 1] - ranges[4, 0])
        driver.steering_1 = ranges[5, 0] + random(g) * (ranges[5, 1] - ranges[5, 0])
    driver.delta = uniform(g, ranges[0, 0], ranges[0, 1])


def behavior_ranges(driver: Any) -> np.ndarray:
    """[6, 2]: what ``randomize_behavior`` draws from: delta, and linear parameters (else zero)."""
    ranges = np.zeros((6, 2))
    ranges[0] = driver.DELTA_RANGE
    if hasattr(driver, "ACCELERATION_RANGE"):
        ranges[1:4], ranges[4:] = driver.ACCELERATION_RANGE.T, driver.STEERING_RANGE.T
    return ranges


class Plans:
    """What ``plan_route_to`` gives from every lane to some destinations."""

    def __init__(self, road: Any, network: Network, destinations: tuple[str, ...]) -> None:
        shape = max(len(destinations), 1), len(network.lanes)
        self.steps = np.zeros((*shape, ROUTE_LENGTH, 2), np.int64)
        self.lengths = np.zeros(shape, np.int64)
        traveller: Any = ControlledVehicle.__new__(ControlledVehicle)
        traveller.road = road
        for d, destination in enumerate(destinations):
            for k, index in enumerate(network.indexes):
                traveller.lane_index = index
                route = traveller.plan_route_to(destination).route
                self.lengths[d, k] = len(route)
                for at, (start, end, lane) in enumerate(route):
                    number = network.numbers[start, end, 0]
                    self.steps[d, k, at] = number, NO_LANE if lane is None else lane


@outlined
def plan(s, i, destination, steps, lengths):
    """``ControlledVehicle.plan_route_to``; steps, lengths: of ``Plans``."""
    vehicle = s.vehicles[i]
    vehicle.route_length, vehicle.route_taken = lengths[destination, vehicle.lane], 0
    for step in range(vehicle.route_length):
        s.routes[i, step, 0] = steps[destination, vehicle.lane, step, 0]
        s.routes[i, step, 1] = steps[destination, vehicle.lane, step, 1]


@outlined
def on_road(s, i):
    """``RoadObject.on_road``."""
    vehicle = s.vehicles[i]
    lane = s.lanes[vehicle.lane]
    longitudinal, lateral = local_coordinates(s, vehicle.lane, vehicle.x, vehicle.y)
    return (
        abs(lateral) <= width_at(s, vehicle.lane, longitudinal) / 2 + 0
        and longitudinal >= -VEHICLE_LENGTH
        and longitudinal < lane.length + VEHICLE_LENGTH
    )


@compiled
def wanted_lane(s, i):
    """The target lane of a controlled vehicle, else the lane that it is on."""
    vehicle = s.vehicles[i]
    return vehicle.target_lane if vehicle.kind >= CONTROLLED else vehicle.lane


@compiled
def lmap(v, x0, x1, y0, y1):
    """``utils.lmap``."""
    return y0 + (v - x0) * (y1 - y0) / (x1 - x0)


# From Python 3.12 on, ``sum`` carries the rounding errors of floats along, but not those of NumPy's
# floats, nor of adding integers.
_COMPENSATED = sys.version_info >= (3, 12)


def weights(config: dict[str, Any], rewards: dict[str, type]) -> list[float]:
    """The weights of ``rewards`` by name, and a bit for each whose product is a Python integer."""
    found = [config.get(name, 0) for name in rewards]
    whole = [kind in (bool, int) and isinstance(weight, int)
             for weight, kind in zip(found, rewards.values(), strict=True)]  # fmt: skip
    return [*found, sum(bit << index for index, bit in enumerate(whole))]


@compiled
def added(total, lost, term):
    """(total, lost) with another float in Python's ``sum``."""
    larger = total + term
    if _COMPENSATED:
        lost += (total - larger) + term if abs(total) >= abs(term) else (term - larger) + total
    return larger, lost


@compiled
def weighted(parts, c, floats):
    """``sum(weight * reward)`` over a reward's parts, as Python adds them.

    c: begins with ``weights``. floats: how many parts there are before the first that is a NumPy
    number.
    """
    total, lost, whole, inexact = 0.0, 0.0, np.int64(c[len(parts)]), False
    for index in range(len(parts)):
        term = c[index] * parts[index]
        if index >= floats:
            total, lost = total + lost + term, 0.0
        elif whole >> index & 1 or not inexact:
            total += term
        else:
            total, lost = added(total, lost, term)
        inexact = inexact or not whole >> index & 1
    return total + lost


@compiled
def distance(s, x1, y1, x2, y2):
    """``np.linalg.norm`` of a difference."""
    dx, dy = x1 - x2, y1 - y2
    return sqrt(dot(s.np.dot, dx, dy, dx, dy))


@compiled
def speed_number(s, i, target_speeds):
    """``MDPVehicle.speed_index``: the number of its target speed."""
    for index in range(len(target_speeds)):
        if target_speeds[index] == s.vehicles[i].target_speed:
            return index
    return -1
