"""Who is next on a lane (``Road.neighbour_vehicles``), from lanes that are kept in order.

Nobody moves while drivers decide, so a lane is sorted once a sub-step, when somebody asks. -1
stands for nobody.
"""

from __future__ import annotations

import numpy as np

from esc_gym.fastsim.geometry import along
from esc_gym.fastsim.numerics import compiled, outlined

NOBODY = -1


@compiled
def forget_ranks(s):
    """Everyone has moved: lanes are sorted anew when somebody asks."""
    for k in range(len(s.ranked)):
        s.ranked[k] = -1


@outlined
def rank(s, k):
    """Who stands on lane k, from behind to ahead; of equals, the first in the list first."""
    count = 0
    for j in range(s.m):
        there = s.seats[k, j]
        if there == there:
            place = count
            while place > 0 and s.seats[k, s.ranks[k, place - 1]] > there:
                s.ranks[k, place] = s.ranks[k, place - 1]
                place -= 1
            s.ranks[k, place] = j
            count += 1
    s.ranked[k] = count


@compiled
def places(s, k, offset, here):
    """(place in ``ranks`` of the first on lane k who is not behind ``here``, their number)."""
    if s.ranked[k] < 0:
        rank(s, k)
    low, high = 0, s.ranked[k]
    while low < high:
        middle = (low + high) >> 1
        if s.seats[k, s.ranks[k, middle]] + offset < here:
            low = middle + 1
        else:
            high = middle
    return low, s.ranked[k]


@compiled
def counts_on(s, k, link, j):
    """Is the lane of ``link`` the first of those of lane k that j stands on?"""
    for earlier in range(s.link_start[k], link):
        there = s.seats[s.link_lane[earlier], j]
        if there == there:
            return False
    return True


@compiled
def neighbours(s, i, k):
    """``Road.neighbour_vehicles``: (front, rear); of equals, the last in front, the first behind.

    A lane's links are itself alone, or with neighbour_vehicles_connected_lanes those before and
    after it; a vehicle counts on the first of them that it stands on.
    """
    here = along(s, k, i)
    front = rear = NOBODY
    front_at, rear_at = np.inf, -np.inf
    for link in range(s.link_start[k], s.link_start[k + 1]):
        lane, offset = s.link_lane[link], s.link_offset[link]
        middle, count = places(s, lane, offset, here)
        for place in range(middle, count):
            j = s.ranks[lane, place]
            there = s.seats[lane, j] + offset
            if there > front_at:
                break
            if j != i and (there < front_at or j > front) and counts_on(s, k, link, j):
                front, front_at = j, there
        for place in range(middle - 1, -1, -1):
            j = s.ranks[lane, place]
            there = s.seats[lane, j] + offset
            if there < rear_at:
                break
            if j != i and (there > rear_at or j < rear) and counts_on(s, k, link, j):
                rear, rear_at = j, there
    return front, rear
