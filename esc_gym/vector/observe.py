"""The set observation in compiled code: what ``SetObservationType.observe`` gives, to the last bit.

``view`` is what ``features.EgoView`` holds, ``s`` the Scene of one environment, ``i`` a vehicle or
object.
"""

from __future__ import annotations

from math import copysign
from typing import Any, NamedTuple

import numpy as np

from esc_gym.fastsim.numerics import compiled, outlined
from esc_gym.features import EGO_FEATURES, VEHICLE_FEATURES
from esc_gym.observation_type import GOALS
from esc_gym.vector import generators
from esc_gym.vector.columns import (
    EGO_COLUMNS,
    VEHICLE_COLUMNS,
    ego_value,
    goal_entry,
    vehicle_row,
    view_of,
)

ORDERS, ROAD, SHUFFLED, DISTANCE = ("road", "shuffled", "distance"), 0, 1, 2
# Entries of ``rules``.
ORDER, BODY_FRAME, VIRTUAL = range(3)


class Spec(NamedTuple):
    """``SetSpec`` for compiled code.

    reach: perception distance [m]. rules: see ORDER. columns [d1], center, half: numbers in
    VEHICLE_COLUMNS and scale of the vehicles' columns; ego_* [d2] likewise. virtual [d1]: the row
    that stands for nobody. goal_scales [6]: of the goal's entries; [0] without goals.
    """

    reach: float
    rules: np.ndarray
    columns: np.ndarray
    center: np.ndarray
    half: np.ndarray
    ego_columns: np.ndarray
    ego_center: np.ndarray
    ego_half: np.ndarray
    virtual: np.ndarray
    goal_scales: np.ndarray


class Output(NamedTuple):
    """One observation of each of E environments, as the spaces have it.

    ego [E, d2], vehicles [E, N, d1], mask [E, N]; ids [E, N] with -1 past the M real rows;
    counts [E, 2]: all that are perceived, and those left out. achieved, desired [E, 6]: the goal's
    entries, [E, 0] without goals.
    """

    ego: np.ndarray
    vehicles: np.ndarray
    mask: np.ndarray
    ids: np.ndarray
    counts: np.ndarray
    achieved: np.ndarray
    desired: np.ndarray

    @classmethod
    def empty(cls, space: Any, count: int) -> Output:
        """Room for observations of ``count`` environments. space: of one."""
        n, goals = space["mask"].n, [space[name].shape if name in space.spaces else (0,)
                                     for name in GOALS]  # fmt: skip
        return cls(
            np.zeros((count, *space["ego"].shape), np.float32),
            np.zeros((count, *space["vehicles"].shape), np.float32),
            np.zeros((count, n), np.int8),
            np.full((count, n), -1),
            np.zeros((count, 2), np.int64),
            *(np.zeros((count, *shape)) for shape in goals),
        )

    def parts(self) -> dict[str, np.ndarray]:
        """What is observed, by name; no copies."""
        parts = {"ego": self.ego, "vehicles": self.vehicles, "mask": self.mask}
        if self.achieved.shape[1]:
            parts |= dict(zip(GOALS, (self.achieved, self.desired), strict=True))
        return parts


def unknown(kind: Any) -> str:
    """Why an observation type cannot be computed here; "" if it can."""
    spec = kind.spec
    for names, known, table in (
        (spec.features, VEHICLE_COLUMNS, VEHICLE_FEATURES),
        (spec.ego_features, EGO_COLUMNS, EGO_FEATURES),
    ):
        for name in names:
            if name not in known or table[name] is not _TABLES[known][name]:
                return f"feature {name!r}"
    return ""


# The rows as they are when this is imported: one that somebody replaces is not known here.
_TABLES = {VEHICLE_COLUMNS: dict(VEHICLE_FEATURES), EGO_COLUMNS: dict(EGO_FEATURES)}


def spec_of(kind: Any) -> Spec:
    """The ``Spec`` of a ``SetObservationType``."""
    spec, rows, ego = kind.spec, kind.rows, kind.ego
    rules = ORDERS.index(spec.order), spec.frame == "ego", spec.empty == "virtual"
    return Spec(
        spec.perception_distance,
        np.array(rules, np.int64),
        np.array([VEHICLE_COLUMNS.index(name) for name in spec.features], np.int64),
        rows.center, rows.half,
        np.array([EGO_COLUMNS.index(name) for name in spec.ego_features], np.int64),
        ego.center, ego.half,
        kind._virtual_row().astype(np.float32),
        np.array(kind.env.observation_type_parking.scales if spec.goal else (), float),
    )  # fmt: skip


@compiled
def perceive(s, view, ego, reach, near, squares):
    """All that is within ``reach``, in road order, into ``near`` and ``squares``; how many."""
    found = 0
    for i in range(s.m):
        other = s.vehicles[i]
        dx, dy = other.x - view.x, other.y - view.y
        square = dx * dx + dy * dy
        if square < reach * reach and i != ego and other.solid:
            near[found], squares[found] = i, square
            found += 1
    return found


@compiled
def by_distance(near, squares, count):
    """Sort by distance; of equals, the first stays first."""
    for place in range(1, count):
        i, square = near[place], squares[place]
        while place > 0 and squares[place - 1] > square:
            near[place], squares[place] = near[place - 1], squares[place - 1]
            place -= 1
        near[place], squares[place] = i, square


@compiled
def nearest(near, squares, count, kept):
    """Leave the ``kept`` nearest, in road order; of equals, the first."""
    ranked, ordered, chosen = near.copy(), squares.copy(), np.zeros(len(near), np.bool_)
    by_distance(ranked, ordered, count)
    for index in range(kept):
        chosen[ranked[index]] = True
    place = 0
    for index in range(count):
        if chosen[near[index]]:
            near[place], squares[place] = near[index], squares[index]
            place += 1


@outlined
def observe(s, ego, e, spec, order_generator, ids, lane, next_id, out):
    """The observation of environment ``e`` into row e of ``out``; the next free id.

    ids [m]: the number by which each vehicle is known since it was first perceived, -1 before.
    lane: that of exit_x and ref_lat_off.
    """
    view = view_of(s, ego, spec.rules[BODY_FRAME])
    near, squares = np.zeros(s.m, np.int64), np.empty(s.m)
    count = perceive(s, view, ego, spec.reach, near, squares)
    for index in range(count):
        if ids[near[index]] < 0:
            ids[near[index]] = next_id
            next_id += 1
    n = out.vehicles.shape[1]
    kept = min(count, n)
    if count > n:
        nearest(near, squares, count, n)
    if spec.rules[ORDER] == DISTANCE:
        by_distance(near, squares, kept)
    elif spec.rules[ORDER] == SHUFFLED:
        generators.shuffle(order_generator, near, kept)
    for row in range(kept):
        vehicle_row(s, view, ego, near[row], spec, out.vehicles[e, row])
        out.ids[e, row] = ids[near[row]]
        out.mask[e, row] = 1
    for row in range(kept, n):
        out.mask[e, row], out.ids[e, row] = 0, -1
        for column in range(len(spec.columns)):
            out.vehicles[e, row, column] = 0.0
    if kept == 0 and spec.rules[VIRTUAL]:
        out.mask[e, 0] = 1
        for column in range(len(spec.columns)):
            out.vehicles[e, 0, column] = spec.virtual[column]
    out.counts[e, 0], out.counts[e, 1] = count, count - kept
    for column in range(len(spec.ego_columns)):
        value = ego_value(s, view, ego, spec.ego_columns[column], lane)
        value = (value - spec.ego_center[column]) / spec.ego_half[column]
        if value > 1.0 or value < -1.0:
            value = copysign(1.0, value)
        out.ego[e, column] = np.float32(value)
    for entry in range(len(spec.goal_scales)):
        out.achieved[e, entry] = goal_entry(s, ego, entry) / spec.goal_scales[entry]
        out.desired[e, entry] = goal_entry(s, s.n, entry) / spec.goal_scales[entry]
    return next_id
