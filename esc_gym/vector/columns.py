"""Every feature of ``features.py`` in compiled code, to the last bit.

``view`` is what ``features.EgoView`` holds, ``s`` the Scene of one environment, ``i`` a vehicle or
object. Sines and cosines are Python's ``math``, as in ``features.py``.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from esc_gym.fastsim.geometry import heading_at, local_coordinates, position
from esc_gym.fastsim.numerics import compiled, cos, dot, libm_of, outlined, sin
from esc_gym.fastsim.records import CONTROLLED, NO_LANE, OBSTACLE
from esc_gym.features import LANE, near_across, near_along
from esc_gym.vector.measures import time_to

# The columns that are known here; their numbers are what the compiled code is told.
VEHICLE_COLUMNS = (
    "x", "y", "vx", "vy", "cos_h", "sin_h", "obstacle", "length", "width", "cos_d", "sin_d",
    "near_x", "near_y", "ahead", "behind", "left", "right", "urgency", "urgency_left",
    "urgency_right",
)  # fmt: skip
(
    X, Y, VX, VY, COS_H, SIN_H, IS_OBSTACLE, LENGTH, WIDTH, COS_D, SIN_D,
    NEAR_X, NEAR_Y, AHEAD, BEHIND, LEFT, RIGHT, URGENCY, URGENCY_LEFT, URGENCY_RIGHT,
) = range(20)  # fmt: skip
EGO_COLUMNS = (
    "speed", "lat_off", "cos_lane", "sin_lane", "lanes_left", "lanes_right", "speed_limit",
    "target_speed", "target_lat_off", "lateral_speed", "yaw_rate", "dest_x", "dest_y",
    "exit_x", "exit_y", "ref_lat_off", "ref_cos", "ref_sin", "goal_x", "goal_y", "goal_cos_h",
    "goal_sin_h",
)  # fmt: skip
(
    SPEED, LAT_OFF, COS_LANE, SIN_LANE, LANES_LEFT, LANES_RIGHT, SPEED_LIMIT, TARGET_SPEED,
    TARGET_LAT_OFF, LATERAL_SPEED, YAW_RATE, DEST_X, DEST_Y, EXIT_X, EXIT_Y, REF_LAT_OFF, REF_COS,
    REF_SIN, GOAL_X, GOAL_Y, GOAL_COS_H, GOAL_SIN_H,
) = range(22)  # fmt: skip


class View(NamedTuple):
    """``features.EgoView``."""

    x: float
    y: float
    heading: float
    speed: float
    vx: float
    vy: float
    cos: float
    sin: float
    longitudinal: float
    lateral: float


@compiled
def view_of(s, ego, body_frame):
    me = s.vehicles[ego]
    c, n = libm_of(s.np.libm_cos, me.heading), libm_of(s.np.libm_sin, me.heading)
    longitudinal, lateral = local_coordinates(s, me.lane, me.x, me.y)
    return View(
        me.x, me.y, me.heading, me.speed, me.speed * c, me.speed * n,
        c if body_frame else 1.0, n if body_frame else 0.0, longitudinal, lateral,
    )  # fmt: skip


@compiled
def forward(view, x, y):
    return view.cos * x + view.sin * y


@compiled
def right(view, x, y):
    return view.cos * y - view.sin * x


@outlined
def destination(s, i):
    """(is there a route, x, y): ``RoadObject.destination``."""
    vehicle = s.vehicles[i]
    if vehicle.route_length == 0:
        return False, vehicle.x, vehicle.y
    last = vehicle.route_taken + vehicle.route_length - 1
    road, lane = s.routes[i, last, 0], s.routes[i, last, 1]
    k = road + (0 if lane == NO_LANE else lane)
    x, y = position(s, k, s.lanes[k].length)
    return True, x, y


@outlined
def destination_direction(s, i):
    """``features._destination``: unit vector to the end of the route."""
    routed, x, y = destination(s, i)
    vehicle = s.vehicles[i]
    dx, dy = x - vehicle.x, y - vehicle.y
    if not routed or (dx == 0.0 and dy == 0.0):
        return 0.0, 0.0
    norm = sqrt(dot(s.np.dot, dx, dy, dx, dy))
    return dx / norm, dy / norm


closeness_along, closeness_across = compiled(near_along), compiled(near_across)


@compiled
def closeness(what, x, y):
    """``features._near``, and its two parts."""
    if (what == AHEAD and x < 0.0) or (what == BEHIND and x > 0.0):
        return 0.0
    along = 1.0 if what == NEAR_Y else closeness_along(x)
    lanes = 1.0 if what == RIGHT else (-1.0 if what == LEFT else 0.0)
    return along * (1.0 if what == NEAR_X else closeness_across(y - LANE * lanes))


@outlined
def vehicle_row(s, view, ego, i, spec, row):
    """The row of one vehicle or obstacle, scaled (``features.default_row`` and the extra ones)."""
    other = s.vehicles[i]
    c, n = libm_of(s.np.libm_cos, other.heading), libm_of(s.np.libm_sin, other.heading)
    dx, dy = other.x - view.x, other.y - view.y
    vx, vy = other.speed * c - view.vx, other.speed * n - view.vy
    turned = not (view.sin == 0.0 and view.cos == 1.0)
    goal_x = goal_y = 0.0
    for column in range(len(spec.columns)):
        what = spec.columns[column]
        if what in (COS_D, SIN_D):
            goal_x, goal_y = destination_direction(s, i)
    for column in range(len(spec.columns)):
        what = spec.columns[column]
        if what == X:
            value = forward(view, dx, dy) if turned else dx
        elif what == Y:
            value = right(view, dx, dy) if turned else dy
        elif what == VX:
            value = forward(view, vx, vy) if turned else vx
        elif what == VY:
            value = right(view, vx, vy) if turned else vy
        elif what == COS_H:
            value = forward(view, c, n) if turned else c
        elif what == SIN_H:
            value = right(view, c, n) if turned else n
        elif what == IS_OBSTACLE:
            value = 1.0 if other.kind >= OBSTACLE else 0.0
        elif what == LENGTH:
            value = other.length
        elif what == WIDTH:
            value = other.width
        elif what == COS_D:
            value = forward(view, goal_x, goal_y)
        elif what == SIN_D:
            value = right(view, goal_x, goal_y)
        elif what >= URGENCY:
            lanes = 0.0 if what == URGENCY else (-1.0 if what == URGENCY_LEFT else 1.0)
            value = 1.0 / (1.0 + time_to(s, ego, i, LANE * lanes))
        else:
            value = closeness(what, forward(view, dx, dy), right(view, dx, dy))
        row[column] = np.float32((value - spec.center[column]) / spec.half[column])


@outlined
def ego_value(s, view, ego, what, lane):
    """One ego feature in physical units (``features.EGO_FEATURES``)."""
    me = s.vehicles[ego]
    here = s.lanes[me.lane]
    if what == SPEED:
        return view.speed
    if what == LAT_OFF:
        return view.lateral
    if what == COS_LANE:
        return libm_of(s.np.libm_cos, view.heading - heading_at(s, me.lane, view.longitudinal))
    if what == SIN_LANE:
        return libm_of(s.np.libm_sin, view.heading - heading_at(s, me.lane, view.longitudinal))
    if what == LANES_LEFT:
        return np.float64(here.id)
    if what == LANES_RIGHT:
        return np.float64(here.count - 1 - here.id)
    if what == SPEED_LIMIT:
        return here.speed_limit if here.limited else 40.0
    if what == TARGET_SPEED:
        return me.target_speed if me.kind >= CONTROLLED else view.speed
    if what == TARGET_LAT_OFF:
        if me.kind < CONTROLLED or me.target_lane == me.lane:
            return view.lateral
        return local_coordinates(s, me.target_lane, me.x, me.y)[1]
    if what == LATERAL_SPEED:
        return me.lateral_speed
    if what == YAW_RATE:
        return me.yaw_rate
    if what in (DEST_X, DEST_Y):
        routed, x, y = destination(s, ego)
        dx, dy = (x - view.x, y - view.y) if routed else (0.0, 0.0)
        return forward(view, dx, dy) if what == DEST_X else right(view, dx, dy)
    if what >= GOAL_X:
        goal = s.vehicles[s.n]
        if what == GOAL_X:
            return forward(view, goal.x - view.x, goal.y - view.y)
        if what == GOAL_Y:
            return right(view, goal.x - view.x, goal.y - view.y)
        c, n = libm_of(s.np.libm_cos, goal.heading), libm_of(s.np.libm_sin, goal.heading)
        return forward(view, c, n) if what == GOAL_COS_H else right(view, c, n)
    longitudinal, lateral = local_coordinates(s, lane, me.x, me.y)
    if what == EXIT_X:
        return longitudinal
    if what in (EXIT_Y, REF_LAT_OFF):
        return lateral
    angle = view.heading - heading_at(s, lane, longitudinal)
    return libm_of(s.np.libm_cos if what == REF_COS else s.np.libm_sin, angle)


@outlined
def goal_entry(s, i, entry):
    """x, y, vx, vy, cos_h or sin_h of ``to_dict``, of a vehicle or of where it is to park.

    With NumPy's sines and cosines, as there.
    """
    thing = s.vehicles[i]
    if entry == 0:
        return thing.x
    if entry == 1:
        return thing.y
    if entry == 2:
        return thing.speed * cos(s.np, thing.heading) if i < s.n else 0.0
    if entry == 3:
        return thing.speed * sin(s.np, thing.heading) if i < s.n else 0.0
    return cos(s.np, thing.heading) if entry == 4 else sin(s.np, thing.heading)
