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


@compiled
def reaches(one, other, dt):
    """Can the two touch within the distance that highway-env looks at? i's number is the lower."""
    if not (one.checks_collisions or other.checks_collisions):
        return False
    reach = (one.diagonal + other.diagonal) / 2 + one.speed * dt + MARGIN
    return abs(other.x - one.x) <= reach and abs(other.y - one.y) <= reach


@outlined
def collide_near(s, i, j, dt, a, b):
    """``RoadObject.handle_collisions`` of two that are near; a, b: scratch for their corners."""
    one, other = s.vehicles[i], s.vehicles[j]
    if not (one.collidable and other.collidable):
        return
    dx, dy = other.x - one.x, other.y - one.y
    if sqrt(dot(s.np.dot, dx, dy, dx, dy)) > (one.diagonal + other.diagonal) / 2 + one.speed * dt:
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


@compiled
def sort_by_x(s, by_x):
    """Sort the numbers in ``by_x`` [m], which are nearly so since the last sub-step."""
    for place in range(1, s.m):
        i = by_x[place]
        x = s.vehicles[i].x
        while place > 0 and s.vehicles[by_x[place - 1]].x > x:
            by_x[place] = by_x[place - 1]
            place -= 1
        by_x[place] = i


@compiled
def find_pairs(s, dt, by_x, pairs):
    """Pairs that may touch, as i * m + j, into ``pairs`` in the order of the list; their number.

    More than there is room for: not all of them are there.
    """
    sort_by_x(s, by_x)
    widest = fastest = 0.0
    for i in range(s.m):
        widest = max(widest, s.vehicles[i].diagonal)
        fastest = max(fastest, s.vehicles[i].speed)
    furthest, found = widest + fastest * dt + MARGIN, 0
    for place in range(s.m):
        i = by_x[place]
        limit = s.vehicles[i].x + furthest
        for next_place in range(place + 1, s.m):
            j = by_x[next_place]
            if s.vehicles[j].x > limit:
                break
            one, other = min(i, j), max(i, j)
            if one < s.n and reaches(s.vehicles[one], s.vehicles[other], dt):
                at = found
                found += 1
                if found > len(pairs):
                    return found
                pair = one * s.m + other
                while at > 0 and pairs[at - 1] > pair:
                    pairs[at] = pairs[at - 1]
                    at -= 1
                pairs[at] = pair
    return found


@merged
def collide_all(s, dt, by_x, pairs):
    """The second half of ``Road.step``: every pair of vehicles, then the objects, in order.

    by_x [m]: the numbers of all, as the last call left them. pairs: scratch.
    """
    a, b = np.empty((5, 2)), np.empty((5, 2))
    found = find_pairs(s, dt, by_x, pairs)
    if found <= len(pairs):
        for pair in range(found):
            collide_near(s, pairs[pair] // s.m, pairs[pair] % s.m, dt, a, b)
        return
    for i in range(s.n):
        for j in range(i + 1, s.m):
            if reaches(s.vehicles[i], s.vehicles[j], dt):
                collide_near(s, i, j, dt, a, b)


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
