"""Lanes: local coordinates, headings, and which lane is the closest (``road/lane.py``).

``s`` is the Scene everywhere, ``i`` a vehicle or object, ``k`` a lane.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from esc_gym.fastsim.numerics import arctan, arctan2, compiled, cos, dot, outlined, sin, wrap_to_pi
from esc_gym.fastsim.records import CIRCULAR, LANDMARK, SINE, SPLINE, STRAIGHT

VEHICLE_LENGTH = 5  # AbstractLane.VEHICLE_LENGTH


@compiled
def circular_lateral(s, k, x, y):
    """The second of ``CircularLane.local_coordinates``."""
    lane = s.lanes[k]
    dx, dy = x - lane.center_x, y - lane.center_y
    return lane.turn * (lane.radius - sqrt(dot(s.np.dot, dx, dy, dx, dy)))


@compiled
def circular_longitudinal(s, k, x, y):
    """The first of ``CircularLane.local_coordinates``."""
    lane = s.lanes[k]
    dx, dy = x - lane.center_x, y - lane.center_y
    phase = arctan2(s.np, dy, dx)
    phase = lane.start_phase + wrap_to_pi(phase - lane.start_phase)
    return lane.turn * (phase - lane.start_phase) * lane.radius


@compiled
def local_coordinates(s, k, x, y):
    """``AbstractLane.local_coordinates`` of each lane class."""
    lane = s.lanes[k]
    if lane.kind == CIRCULAR:
        return circular_longitudinal(s, k, x, y), circular_lateral(s, k, x, y)
    if lane.kind == SPLINE:
        return spline_coordinates(s, k, x, y)
    dx, dy = x - lane.start_x, y - lane.start_y
    longitudinal = dot(s.np.dot, dx, dy, lane.direction_x, lane.direction_y)
    lateral = dot(s.np.dot, dx, dy, lane.lateral_x, lane.lateral_y)
    if lane.kind == SINE:
        angle = lane.pulsation * longitudinal + lane.phase
        lateral = lateral - lane.amplitude * sin(s.np, angle)
    return longitudinal, lateral


@compiled
def along(s, k, i):
    """Longitudinal coordinate of vehicle i on lane k."""
    longitudinal = s.lon[k, i]
    if longitudinal != longitudinal:
        longitudinal = circular_longitudinal(s, k, s.vehicles[i].x, s.vehicles[i].y)
        s.lon[k, i] = longitudinal
    return longitudinal


@outlined
def spline_coordinates(s, k, x, y):
    """``LinearSpline2D.cartesian_to_frenet``: the last sample that the point is not behind."""
    first, count = s.lanes[k].poses, s.lanes[k].poses_count
    for index in range(count - 1, -1, -1):
        pose = s.poses[first + index]
        dx, dy = x - pose[1], y - pose[2]
        longitudinal = dot(s.np.dot, pose[3], pose[4], dx, dy)
        if longitudinal >= 0 or index == 0:
            lateral = dot(s.np.dot, pose[5], pose[6], dx, dy)
            return (longitudinal if index == 0 else pose[0] + longitudinal), lateral
    return np.nan, np.nan  # a spline has at least one sample


@compiled
def heading_at(s, k, longitudinal):
    """``AbstractLane.heading_at``."""
    lane = s.lanes[k]
    if lane.kind == STRAIGHT:
        return lane.heading
    if lane.kind == CIRCULAR:
        phase = lane.turn * longitudinal / lane.radius + lane.start_phase
        return phase + np.pi / 2 * lane.turn
    if lane.kind == SPLINE:
        index = 0
        while index < lane.poses_count and s.poses[lane.poses + index, 0] <= longitudinal:
            index += 1
        return s.poses[lane.poses + max(index - 1, 0), 7]
    slope = cos(s.np, lane.pulsation * longitudinal + lane.phase)
    slope = lane.amplitude * lane.pulsation * slope
    return lane.heading + arctan(s.np, slope)


@compiled
def width_at(s, k, longitudinal):
    """``AbstractLane.width_at``."""
    lane = s.lanes[k]
    if lane.widths_count == 0:
        return lane.width
    if longitudinal < 0:
        return s.widths[lane.widths]
    index = min(np.int64(longitudinal), lane.widths_count - 1)
    return s.widths[lane.widths + index]


@compiled
def position(s, k, longitudinal):
    """``AbstractLane.position`` on the centre line (splines are not asked for it)."""
    lane = s.lanes[k]
    if lane.kind == CIRCULAR:
        phase = lane.turn * longitudinal / lane.radius + lane.start_phase
        x = lane.center_x + lane.radius * cos(s.np, phase)
        return x, lane.center_y + lane.radius * sin(s.np, phase)
    x = lane.start_x + longitudinal * lane.direction_x
    y = lane.start_y + longitudinal * lane.direction_y
    if lane.kind == SINE:
        angle = lane.pulsation * longitudinal + lane.phase
        lateral = lane.amplitude * sin(s.np, angle)
        x, y = x + lateral * lane.lateral_x, y + lateral * lane.lateral_y
    return x, y


@compiled
def on_lane(s, k, i, margin):
    """``AbstractLane.on_lane``."""
    length = s.lanes[k].length
    if s.lanes[k].widths_count == 0 and abs(s.lat[k, i]) > s.lanes[k].width / 2 + margin:
        return False
    longitudinal = along(s, k, i)
    return (
        abs(s.lat[k, i]) <= width_at(s, k, longitudinal) / 2 + margin
        and longitudinal >= -VEHICLE_LENGTH
        and longitudinal < length + VEHICLE_LENGTH
    )


@compiled
def is_reachable(s, k, i):
    """``AbstractLane.is_reachable_from``."""
    longitudinal = along(s, k, i)
    return (
        not s.lanes[k].forbidden
        and abs(s.lat[k, i]) <= 2 * width_at(s, k, longitudinal)
        and longitudinal >= 0
        and longitudinal < s.lanes[k].length + VEHICLE_LENGTH
    )


@compiled
def after_end(s, k, i):
    """``AbstractLane.after_end``."""
    return along(s, k, i) > s.lanes[k].length - VEHICLE_LENGTH / 2


@compiled
def l1_distance(lane, longitudinal, lateral):
    """``AbstractLane.distance`` at local coordinates."""
    return abs(lateral) + max(longitudinal - lane.length, 0.0) + max(0 - longitudinal, 0.0)


@compiled
def distance_with_heading(s, k, i):
    """``AbstractLane.distance_with_heading``."""
    longitudinal = along(s, k, i)
    angle = abs(wrap_to_pi(s.vehicles[i].heading - heading_at(s, k, longitudinal)))
    return l1_distance(s.lanes[k], longitudinal, s.lat[k, i]) + 1.0 * angle


@compiled
def locate(s, i):
    """Everything that follows from a new position and heading, the vehicle's lane excepted."""
    vehicle = s.vehicles[i]
    vehicle.cos = cos(s.np, vehicle.heading)
    vehicle.sin = sin(s.np, vehicle.heading)
    neighbour = vehicle.kind != LANDMARK
    for k in range(len(s.lanes)):
        if s.lanes[k].kind == CIRCULAR:
            s.lon[k, i], s.lat[k, i] = np.nan, circular_lateral(s, k, vehicle.x, vehicle.y)
        else:
            s.lon[k, i], s.lat[k, i] = local_coordinates(s, k, vehicle.x, vehicle.y)
        s.seats[k, i] = along(s, k, i) if neighbour and on_lane(s, k, i, 1) else np.nan


@compiled
def closest_lane(s, i):
    """``RoadNetwork.get_closest_lane_index``: the first of the nearest lanes.

    Starts with the present lane: most others are then further off without looking at headings,
    since adding the angle to a distance cannot make it smaller, not even rounded.
    """
    best = s.vehicles[i].lane
    least = distance_with_heading(s, best, i)
    for k in range(len(s.lanes)):
        lateral = s.lat[k, i]
        if abs(lateral) > least or l1_distance(s.lanes[k], along(s, k, i), lateral) > least:
            continue
        candidate = distance_with_heading(s, k, i)
        if candidate < least or (candidate == least and k < best):
            best, least = k, candidate
    return best
