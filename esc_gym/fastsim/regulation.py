"""Who yields at an intersection: ``RegulatedRoad.enforce_road_rules`` (``road/regulation.py``)."""

from __future__ import annotations

from math import sqrt

import numpy as np

from esc_gym.fastsim.collisions import has_corner_inside
from esc_gym.fastsim.geometry import along, heading_at, position
from esc_gym.fastsim.motion import move
from esc_gym.fastsim.numerics import compiled, dot, outlined
from esc_gym.fastsim.records import BICYCLE, CONTROLLED, MDP, NO_LANE, PLAIN, YIELD

# RegulatedRoad.is_conflict_possible: np.arange(step, horizon, step), exact in binary.
HORIZON, INTERVAL = 11, 0.25


@compiled
def lane_ahead(s, i, ahead):
    """The lane of a step of the route; where it is open, numbered as the present lane is."""
    vehicle = s.vehicles[i]
    if vehicle.route_length == 0:
        return vehicle.lane
    step = vehicle.route_taken + ahead
    road, lane = s.routes[i, step, 0], s.routes[i, step, 1]
    return road + (s.lanes[vehicle.lane].id if lane == NO_LANE else lane)


@compiled
def predict_along_route(s, i, path):
    """``ControlledVehicle.predict_trajectory_constant_speed`` into ``path`` [11, 3]."""
    vehicle = s.vehicles[i]
    steps = max(vehicle.route_length, 1)
    for index in range(HORIZON):
        longitudinal = along(s, vehicle.lane, i) + vehicle.speed * (INTERVAL * (index + 1))
        ahead = 0
        lane = lane_ahead(s, i, 0)
        while steps - ahead > 1 and longitudinal > s.lanes[lane].length:
            longitudinal -= s.lanes[lane].length
            ahead += 1
            lane = lane_ahead(s, i, ahead)
        path[index, 0], path[index, 1] = position(s, lane, longitudinal)
        path[index, 2] = heading_at(s, lane, longitudinal)


@compiled
def predict_constant_action(s, i, path):
    """``Vehicle.predict_trajectory_constant_speed``: a copy of the vehicle is moved."""
    s.vehicles[s.m] = s.vehicles[i]
    ghost = s.vehicles[s.m]
    ghost.acceleration = 0.0
    if ghost.coasts:
        ghost.steering = 0.0
    for index in range(HORIZON):
        move(s, s.m, INTERVAL)
        path[index, 0], path[index, 1], path[index, 2] = ghost.x, ghost.y, ghost.heading


@compiled
def conflict(s, i, j, one, other):
    """``RegulatedRoad.is_conflict_possible`` of two predicted paths."""
    v1, v2 = s.vehicles[i], s.vehicles[j]
    for index in range(HORIZON):
        dx, dy = other[index, 0] - one[index, 0], other[index, 1] - one[index, 1]
        if sqrt(dot(s.np.dot, dx, dy, dx, dy)) > v1.length:
            continue
        l1, w1, l2, w2 = 1.5 * v1.length, 0.9 * v1.width, 1.5 * v2.length, 0.9 * v2.width
        x1, y1, h1 = one[index, 0], one[index, 1], one[index, 2]
        x2, y2, h2 = other[index, 0], other[index, 1], other[index, 2]
        if has_corner_inside(s.np, x1, y1, h1, x2, y2, h2, l1, w1, l2, w2):
            return True
        if has_corner_inside(s.np, x2, y2, h2, x1, y1, h1, l2, w2, l1, w1):
            return True
    return False


@compiled
def front_distance(s, i, j):
    """``RoadObject.front_distance_to``."""
    one, other = s.vehicles[i], s.vehicles[j]
    return dot(s.np.dot, one.cos, one.sin, other.x - one.x, other.y - one.y)


@compiled
def yielding(s, i, j):
    """``RegulatedRoad.respect_priorities``: the one that has to yield."""
    mine, theirs = s.lanes[s.vehicles[i].lane].priority, s.lanes[s.vehicles[j].lane].priority
    if mine > theirs:
        return j
    if mine < theirs:
        return i
    return i if front_distance(s, i, j) > front_distance(s, j, i) else j


@outlined
def enforce_road_rules(s, patience):
    """``RegulatedRoad.enforce_road_rules``; patience: after how many checks yielding ends."""
    for i in range(s.n):
        vehicle = s.vehicles[i]
        if vehicle.yielding:
            vehicle.changed |= YIELD
            if vehicle.yield_timer >= patience:
                vehicle.target_speed = s.lanes[vehicle.lane].speed_limit
                vehicle.yielding = 0
            else:
                vehicle.yield_timer += 1
    paths = np.empty((s.n, HORIZON, 3))
    for i in range(s.n):
        if s.vehicles[i].kind == PLAIN or s.vehicles[i].kind == BICYCLE:
            predict_constant_action(s, i, paths[i])
        else:
            predict_along_route(s, i, paths[i])
    for i in range(s.n - 1):
        for j in range(i + 1, s.n):
            if conflict(s, i, j, paths[i], paths[j]):
                vehicle = s.vehicles[yielding(s, i, j)]
                if vehicle.kind >= CONTROLLED and vehicle.kind != MDP:
                    vehicle.target_speed = 0.0
                    vehicle.yielding, vehicle.yield_timer = 1, 0
                    vehicle.changed |= YIELD
