"""Rectangles that touch: collisions (``RoadObject.handle_collisions``), and those of the future."""

from __future__ import annotations

from math import sqrt

import numpy as np

from esc_gym.fastsim.numerics import compiled, cos, dot, merged, outlined, sin
from esc_gym.fastsim.records import CRASH, HIT, IMPACT, OBSTACLE

# Pairs further apart than this beyond touching are skipped before the exact distance is computed:
# far more than any rounding, far less than a metre.
MARGIN = 1e-6


@compiled
def rectangle(numerics, x, y, length, width, c, s, corners):
    """``RoadObject.polygon``: four corners and the first again, into ``corners`` [5, 2]."""
    for index in range(5):
        u = length / 2 if index in (2, 3) else -length / 2
        v = width / 2 if index in (1, 2) else -width / 2
        corners[index, 0] = dot(numerics.matrix_matrix, c, -s, u, v) + x
        corners[index, 1] = dot(numerics.matrix_matrix, s, c, u, v) + y


@compiled
def interval_distance(low_a, high_a, low_b, high_b):
    """``utils.interval_distance``."""
    return low_b - high_a if low_a < low_b else low_a - high_b


@compiled
def project(rounding, corners, nx, ny):
    """``utils.project_polygon``: (least, greatest) along an axis."""
    low = high = dot(rounding, corners[0, 0], corners[0, 1], nx, ny)
    for index in range(1, 5):
        along = dot(rounding, corners[index, 0], corners[index, 1], nx, ny)
        low, high = min(low, along), max(high, along)
    return low, high


@compiled
def center(corners, axis):
    """Mean of the four corners, in NumPy's order of addition."""
    total = corners[0, axis] + corners[1, axis] + corners[2, axis] + corners[3, axis]
    return total / 4


@compiled
def polygons_intersecting(rounding, a, b, dx, dy):
    """``utils.are_polygons_intersecting``: (now, soon, translation x, y).

    (dx, dy): displacement of a minus displacement of b. The translation means something only if
    they will intersect.
    """
    now = soon = True
    least, tx, ty = np.inf, 0.0, 0.0
    for corners in (a, b):
        for edge in range(4):
            nx = -corners[edge + 1, 1] + corners[edge, 1]
            ny = corners[edge + 1, 0] - corners[edge, 0]
            norm = sqrt(dot(rounding, nx, ny, nx, ny))
            nx, ny = nx / norm, ny / norm
            low_a, high_a = project(rounding, a, nx, ny)
            low_b, high_b = project(rounding, b, nx, ny)
            if interval_distance(low_a, high_a, low_b, high_b) > 0:
                now = False
            approach = dot(rounding, nx, ny, dx, dy)
            if approach < 0:
                low_a += approach
            else:
                high_a += approach
            gap = interval_distance(low_a, high_a, low_b, high_b)
            if gap > 0:
                soon = False
            if not now and not soon:
                break
            if abs(gap) < least:
                least = abs(gap)
                away_x, away_y = center(a, 0) - center(b, 0), center(a, 1) - center(b, 1)
                if dot(rounding, away_x, away_y, nx, ny) > 0:
                    tx, ty = nx, ny
                else:
                    tx, ty = -nx, -ny
    return now, soon, least * tx, least * ty


@compiled
def push(vehicle, x, y):
    vehicle.impact_x, vehicle.impact_y, vehicle.has_impact = x, y, 1
    vehicle.changed |= IMPACT


@outlined
def collide_near(s, i, j, dt, reach, a, b):
    """``RoadObject.handle_collisions`` of two that are near; a, b: scratch for their corners."""
    one, other = s.vehicles[i], s.vehicles[j]
    if not (one.checks_collisions or other.checks_collisions):
        return
    if not (one.collidable and other.collidable):
        return
    dx, dy = other.x - one.x, other.y - one.y
    if sqrt(dot(s.np.dot, dx, dy, dx, dy)) > reach:
        return
    rectangle(s.np, one.x, one.y, one.length, one.width, one.cos, one.sin, a)
    rectangle(s.np, other.x, other.y, other.length, other.width, other.cos, other.sin, b)
    dx = one.speed * one.cos * dt - other.speed * other.cos * dt
    dy = one.speed * one.sin * dt - other.speed * other.sin * dt
    now, soon, tx, ty = polygons_intersecting(s.np.dot, a, b, dx, dy)
    solid = one.solid and other.solid
    if soon and solid:
        if other.kind == OBSTACLE:
            push(one, tx, ty)
        else:
            push(one, tx / 2, ty / 2)
            push(other, -tx / 2, -ty / 2)
    if now and solid:
        one.crashed = other.crashed = 1
        one.changed |= CRASH
        other.changed |= CRASH
    if now and not one.solid:
        one.hit = 1
        one.changed |= HIT
    if now and not other.solid:
        other.hit = 1
        other.changed |= HIT


@merged
def collide_all(s, dt):
    """The second half of ``Road.step``: every pair of vehicles, then the objects, in order."""
    a, b, xs = np.empty((5, 2)), np.empty((5, 2)), np.empty(s.m)
    widest = 0.0
    for j in range(s.m):
        xs[j] = s.vehicles[j].x
        widest = max(widest, s.vehicles[j].diagonal)
    for i in range(s.n):
        one = s.vehicles[i]
        x, y, ahead = one.x, one.y, one.speed * dt
        bound = (one.diagonal + widest) / 2 + ahead + MARGIN
        for j in range(i + 1, s.m):
            if abs(xs[j] - x) > bound:  # most pairs end here
                continue
            other = s.vehicles[j]
            reach = (one.diagonal + other.diagonal) / 2 + ahead
            if abs(other.x - x) <= reach + MARGIN and abs(other.y - y) <= reach + MARGIN:
                collide_near(s, i, j, dt, reach, a, b)


@compiled
def inside(numerics, px, py, x, y, length, width, c, s):
    """``utils.point_in_rotated_rectangle``."""
    dx, dy = px - x, py - y
    u = dot(numerics.matrix_vector, c, -s, dx, dy)
    v = dot(numerics.matrix_vector, s, c, dx, dy)
    return -length / 2 <= u and u <= length / 2 and -width / 2 <= v and v <= width / 2


@compiled
def corner_offsets(index, length, width):
    """The points of ``utils.rect_corners`` with midpoints and centre, before turning."""
    u = v = 0.0
    if index in (0, 1, 5):
        u = -length / 2
    elif index in (2, 3, 6):
        u = length / 2
    if index in (0, 3, 7):
        v = -width / 2
    elif index in (1, 2, 8):
        v = width / 2
    return u, v


@compiled
def has_corner_inside(numerics, x1, y1, h1, x2, y2, h2, length, width, length_2, width_2):
    """``utils.has_corner_inside``."""
    c1, s1 = cos(numerics, h1), sin(numerics, h1)
    c2, s2 = cos(numerics, h2), sin(numerics, h2)
    for index in range(9):
        u, v = corner_offsets(index, length, width)
        px = dot(numerics.matrix_matrix, c1, -s1, u, v) + x1
        py = dot(numerics.matrix_matrix, s1, c1, u, v) + y1
        if inside(numerics, px, py, x2, y2, length_2, width_2, c2, s2):
            return True
    return False
