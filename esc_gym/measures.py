"""How the ego is driving, measured on highway-env's objects: ``vector.measures`` on records."""

from __future__ import annotations

from math import cos, inf, sin
from typing import Any


def speed_along_lane(vehicle: Any) -> float:
    """What of a vehicle's speed brings it on along its lane [m/s]."""
    longitudinal, _ = vehicle.lane.local_coordinates(vehicle.position)
    return vehicle.speed * cos(vehicle.heading - vehicle.lane.heading_at(longitudinal))


def time_to_collision(env: Any) -> float:
    """Seconds until the ego first touches a vehicle or obstacle, all velocities kept; inf if never.

    env: a highway-env environment. Every body is taken as the rectangle, along the ego's axes, that
    encloses it: exact for bodies parallel to the ego, early by a little for others.
    """
    ego = env.vehicle
    others = [o for o in (*env.road.vehicles, *env.road.objects) if o.solid and o is not ego]
    return min((time_to(ego, other) for other in others), default=inf)


def time_to(ego: Any, other: Any, aside: float = 0.0) -> float:
    """Seconds until the ego touches ``other``, both velocities kept; inf if never.

    aside: the ego is taken to be so far [m] to the right of where it is.
    """
    c, s = cos(ego.heading), sin(ego.heading)
    turn = other.heading - ego.heading
    along, across = abs(cos(turn)), abs(sin(turn))
    vx, vy = (other.velocity - ego.velocity).tolist()
    x, y = (other.position - ego.position).tolist()
    reach_x = (ego.LENGTH + other.LENGTH * along + other.WIDTH * across) / 2
    reach_y = (ego.WIDTH + other.LENGTH * across + other.WIDTH * along) / 2
    enter_x, leave_x = _overlap(c * x + s * y, c * vx + s * vy, reach_x)
    enter_y, leave_y = _overlap(c * y - s * x - aside, c * vy - s * vx, reach_y)
    enter, leave = max(enter_x, enter_y, 0.0), min(leave_x, leave_y)
    return enter if enter <= leave else inf


def _overlap(distance: float, speed: float, reach: float) -> tuple[float, float]:
    """When |distance + speed * t| <= reach: (from, until) [s], (inf, -inf) for never."""
    if abs(speed) < 1e-9:
        return (-inf, inf) if abs(distance) <= reach else (inf, -inf)
    first, second = (-reach - distance) / speed, (reach - distance) / speed
    return min(first, second), max(first, second)
