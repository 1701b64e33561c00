"""``esc_gym.measures``, on the records of a batch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from esc_gym.fastsim.cache import cached
from esc_gym.fastsim.geometry import heading_at, local_coordinates
from esc_gym.fastsim.numerics import compiled, cos, libm_of, outlined, sin
from esc_gym.vector.scenes.roads import on_road


class Measured(NamedTuple):
    """How E egos are driving.

    speed [E] and what of it brings one on along the lane, along [E] [m/s]; crashed, on_road [E];
    road, lane [E]: the lane it is on, a road by a number of ours; time [E]: to collision [s], inf
    for never.
    """

    speed: np.ndarray
    crashed: np.ndarray
    along: np.ndarray
    on_road: np.ndarray
    road: np.ndarray
    lane: np.ndarray
    time: np.ndarray

    @classmethod
    def empty(cls, count: int) -> Measured:
        return cls(
            np.zeros(count), np.zeros(count, bool), np.zeros(count), np.zeros(count, bool),
            np.zeros(count, np.int64), np.zeros(count, np.int64), np.full(count, np.inf),
        )  # fmt: skip


@cached
def count_step(
    lengths, returns, speeds, vehicles, progress, least_time, off_road, changes, roads, lanes,
    rewards, counts, frequency, speed, along, is_on_road, road, lane, time
):  # fmt: skip
    """A step of all episodes, into what ``sb3.Episodes`` knows of them.

    rewards [E], counts [E]: of M; frequency: of policy steps [Hz]; the rest is of ``Measured``.
    """
    for e in range(len(lengths)):
        returns[e, lengths[e]], speeds[e, lengths[e]] = rewards[e], speed[e]
        lengths[e] += 1
        vehicles[e] += counts[e]
        progress[e] += along[e] / frequency
        off_road[e] += not is_on_road[e]
        # Lane numbers of different roads are unrelated: only a change within one road counts.
        changes[e] += road[e] == roads[e] and lane[e] != lanes[e]
        roads[e], lanes[e] = road[e], lane[e]
        least_time[e] = min(least_time[e], time[e])


@outlined
def measure(s, ego, e, measured, collisions):
    """How the ego of environment e drives, into ``measured``; time only with ``collisions``."""
    me = s.vehicles[ego]
    measured.speed[e], measured.crashed[e] = me.speed, me.crashed
    measured.along[e] = speed_along_lane(s, ego)
    measured.on_road[e] = on_road(s, ego)
    measured.road[e], measured.lane[e] = s.lanes[me.lane].road, s.lanes[me.lane].id
    if collisions:
        measured.time[e] = time_to_collision(s, ego)


@outlined
def speed_along_lane(s, i):
    """``measures.speed_along_lane``."""
    me = s.vehicles[i]
    longitudinal, _ = local_coordinates(s, me.lane, me.x, me.y)
    turned = me.heading - heading_at(s, me.lane, longitudinal)
    return me.speed * libm_of(s.np.libm_cos, turned)


@outlined
def time_to_collision(s, ego):
    """``measures.time_to_collision``."""
    least = np.inf
    for i in range(s.m):
        if i != ego and s.vehicles[i].solid:
            least = min(least, time_to(s, ego, i, 0.0))
    return least


@compiled
def time_to(s, i, j, aside):
    """``measures.time_to``."""
    me, other = s.vehicles[i], s.vehicles[j]
    c, d = libm_of(s.np.libm_cos, me.heading), libm_of(s.np.libm_sin, me.heading)
    turn = other.heading - me.heading
    straight, across = abs(libm_of(s.np.libm_cos, turn)), abs(libm_of(s.np.libm_sin, turn))
    vx = other.speed * cos(s.np, other.heading) - me.speed * cos(s.np, me.heading)
    vy = other.speed * sin(s.np, other.heading) - me.speed * sin(s.np, me.heading)
    x, y = other.x - me.x, other.y - me.y
    reach_x = (me.length + other.length * straight + other.width * across) / 2
    reach_y = (me.width + other.length * across + other.width * straight) / 2
    enter_x, leave_x = overlap(c * x + d * y, c * vx + d * vy, reach_x)
    enter_y, leave_y = overlap(c * y - d * x - aside, c * vy - d * vx, reach_y)
    enter, leave = max(enter_x, enter_y, 0.0), min(leave_x, leave_y)
    return enter if enter <= leave else np.inf


@compiled
def overlap(distance, speed, reach):
    """``measures._overlap``."""
    if abs(speed) < 1e-9:
        return (-np.inf, np.inf) if abs(distance) <= reach else (np.inf, -np.inf)
    first, second = (-reach - distance) / speed, (reach - distance) / speed
    return min(first, second), max(first, second)
