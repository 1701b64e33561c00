"""How vehicles come onto a road: what highway-env's constructors do, on records."""

from __future__ import annotations

import numpy as np

from esc_gym.fastsim.geometry import (
    VEHICLE_LENGTH,
    closest_lane,
    heading_at,
    local_coordinates,
    locate,
    width_at,
)
from esc_gym.fastsim.numerics import compiled, outlined
from esc_gym.fastsim.records import CONTROLLED, IDM, LINEAR
from esc_gym.vector.generators import below, random, uniform


@outlined
def appear(s, i, k, longitudinal, lateral, speed):
    """A new vehicle at coordinates of the straight lane k (the constructors of its class)."""
    vehicle, lane = s.vehicles[i], s.lanes[k]
    vehicle.x = lane.start_x + longitudinal * lane.direction_x + lateral * lane.lateral_x
    vehicle.y = lane.start_y + longitudinal * lane.direction_y + lateral * lane.lateral_y
    vehicle.heading, vehicle.speed = heading_at(s, k, longitudinal), speed
    vehicle.lane = k
    locate(s, i)
    vehicle.lane = vehicle.target_lane = closest_lane(s, i)
    if vehicle.kind >= IDM:
        vehicle.target_speed = speed
        vehicle.timer = ((vehicle.x + vehicle.y) * np.pi) % vehicle.lane_change_delay


@compiled
def furthest(s, k, count):
    """The greatest longitudinal coordinate on lane k of the first ``count`` vehicles."""
    most = -np.inf
    for j in range(count):
        most = max(most, local_coordinates(s, k, s.vehicles[j].x, s.vehicles[j].y)[0])
    return most


@outlined
def appear_at_random(s, i, g, road, lane, speed, spacing, density):
    """``Vehicle.create_random`` on ``road``, vehicle i behind none of those before it.

    lane: its number, or -1 for any; speed: or NaN for any. density: exp(-5 / 40 * lanes), NumPy's.
    """
    k = road + (lane if lane >= 0 else below(g, s.lanes[road].count))
    limit = s.lanes[k].speed_limit
    if speed != speed:
        speed = uniform(g, 0.7 * limit, 0.8 * limit) if s.lanes[k].limited else uniform(g, 23, 25)
    offset = spacing * (12 + 1.0 * speed) * density
    ahead = furthest(s, k, i) if i > 0 else 3 * offset
    ahead += offset * uniform(g, 0.9, 1.1)
    appear(s, i, k, ahead, 0.0, speed)


@outlined
def randomize(s, i, g, ranges):
    """``randomize_behavior``; ranges [6, 2]: of delta, and of the parameters of linear drivers."""
    driver = s.vehicles[i]
    if driver.kind == LINEAR:
        driver.acceleration_0 = ranges[1, 0] + random(g) * (ranges[1, 1] - ranges[1, 0])
        driver.acceleration_1 = ranges[2, 0] + random(g) * (ranges[2, 1] - ranges[2, 0])
        driver.acceleration_2 = ranges[3, 0] + random(g) * (ranges[3, 1] - ranges[3, 0])
        driver.steering_0 = ranges[4, 0] + random(g) * (ranges[4, 1] - ranges[4, 0])
        driver.steering_1 = ranges[5, 0] + random(g) * (ranges[5, 1] - ranges[5, 0])
    driver.delta = uniform(g, ranges[0, 0], ranges[0, 1])


@compiled
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
def lane_number(s, i):
    """Number of the target lane of a controlled vehicle, else of its lane, as rewards count it."""
    vehicle = s.vehicles[i]
    return s.lanes[vehicle.target_lane if vehicle.kind >= CONTROLLED else vehicle.lane].id


@compiled
def lmap(v, x0, x1, y0, y1):
    """``utils.lmap``."""
    return y0 + (v - x0) * (y1 - y0) / (x1 - x0)
