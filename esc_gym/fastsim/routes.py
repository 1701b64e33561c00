"""Which lane follows the one that ends (``ControlledVehicle.follow_road``, ``next_lane``)."""

from __future__ import annotations

import numpy as np

from esc_gym.fastsim.geometry import after_end, along, l1_distance, local_coordinates, position
from esc_gym.fastsim.numerics import compiled, outlined
from esc_gym.fastsim.records import NO_LANE, NO_ROAD, SPLINE, TARGET_CHANGED

# What ``follow_road`` may answer.
FOLLOWED, ASK_PYTHON = range(2)


@compiled
def lane_on_road(s, k, road, lane, x, y):
    """``next_lane_given_next_road``: (lane, its distance to the point x, y)."""
    best = road + (s.lanes[k].id if lane == NO_LANE else lane)
    if s.lanes[k].count != s.lanes[road].count:
        best, least = road, np.inf
        for other in range(road, road + s.lanes[road].count):
            longitudinal, lateral = local_coordinates(s, other, x, y)
            distance = l1_distance(s.lanes[other], longitudinal, lateral)
            if distance < least:
                best, least = other, distance
    longitudinal, lateral = local_coordinates(s, best, x, y)
    return best, l1_distance(s.lanes[best], longitudinal, lateral)


@compiled
def planned_road(s, vehicle, i, k):
    """The road that the route says comes after lane k; drops the step of the route that is done."""
    if vehicle.route_length > 0 and s.routes[i, vehicle.route_taken, 0] == s.lanes[k].road:
        vehicle.route_length -= 1
        vehicle.route_taken += 1
    if vehicle.route_length == 0:
        return NO_ROAD, NO_LANE
    step = vehicle.route_taken
    return s.routes[i, step, 0], s.routes[i, step, 1]


@compiled
def is_exit(s, k, road):
    """Does ``road`` start where lane k ends?"""
    lane = s.lanes[k]
    found = False
    for index in range(lane.exits, lane.exits + lane.exits_count):
        found = found or s.exits[index] == road
    return found


@compiled
def leaves_network(s, vehicle, i, k):
    """Must Python choose? A route that leads elsewhere, which is logged, or is out of order."""
    step = vehicle.route_taken
    if vehicle.route_length > 0 and s.routes[i, step, 0] == s.lanes[k].road:
        step += 1
    if step < vehicle.route_taken + vehicle.route_length:
        road, lane = s.routes[i, step, 0], s.routes[i, step, 1]
        if road == NO_ROAD or not is_exit(s, k, road):
            return True
        return lane != NO_LANE and not (lane >= 0 and lane < s.lanes[road].count)
    return False


@outlined
def go_on(s, i):
    """``ControlledVehicle.follow_road`` of a vehicle at the end of its lane."""
    vehicle = s.vehicles[i]
    k = vehicle.target_lane
    if s.lanes[k].kind == SPLINE or leaves_network(s, vehicle, i, k):
        return ASK_PYTHON
    road, lane = planned_road(s, vehicle, i, k)
    x, y = position(s, k, along(s, k, i))
    if road != NO_ROAD:
        target, _ = lane_on_road(s, k, road, lane, x, y)
    else:
        target, least = k, np.inf
        for index in range(s.lanes[k].exits, s.lanes[k].exits + s.lanes[k].exits_count):
            candidate, distance = lane_on_road(s, k, s.exits[index], NO_LANE, x, y)
            if distance < least:
                target, least = candidate, distance
    if target != k:
        vehicle.target_lane = target
        vehicle.changed |= TARGET_CHANGED
    return FOLLOWED


@compiled
def follow_road(s, i):
    """``ControlledVehicle.follow_road``; mostly there is nothing to do, and no call is made."""
    if not after_end(s, s.vehicles[i].target_lane, i):
        return FOLLOWED
    return go_on(s, i)
