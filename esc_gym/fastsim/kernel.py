"""The two functions that Python calls: ``run`` a policy step, ``check`` the numerics.

Only these are cached on disk; everything they call is compiled into them.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from esc_gym.fastsim.cache import cached
from esc_gym.fastsim.collisions import collide_all, corner_offsets, rectangle
from esc_gym.fastsim.driving import acts, change_lane, collect, drive
from esc_gym.fastsim.geometry import locate
from esc_gym.fastsim.motion import step
from esc_gym.fastsim.neighbours import forget_ranks
from esc_gym.fastsim.numerics import (
    arcsin,
    arctan,
    arctan2,
    borrowed,
    compiled,
    cos,
    dot,
    dot3,
    libm,
    libm_of,
    merged,
    power,
    sin,
    square,
    tan,
    wrap_to_pi,
)
from esc_gym.fastsim.records import (
    LANE,
    LARGEST,
    LINEAR,
    NOTHING,
    POSE_COLUMNS,
    SAMPLE_COLUMNS,
    VEHICLE,
    Numerics,
    Scene,
)
from esc_gym.fastsim.regulation import enforce_road_rules
from esc_gym.fastsim.routes import ASK_PYTHON, follow_road

DONE, NOT_FINITE = -1, -2
# Entries of ``progress``.
FRAME, DRIVER, RESUMED, SAMPLES, COMMAND = range(5)
# Columns of ``counts``: vehicles (n), vehicles and objects (m), ``RegulatedRoad.steps``, and the
# number of the vehicle that takes an action.
VEHICLES, ITEMS, ROAD_STEPS, EGO = range(4)


@compiled
def unpack(n):
    """``Numerics`` of the integers that Python passes: a tuple would have to be typed each call."""
    return Numerics(n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7], n[8], n[9], n[10], n[11],
                    n[12], n[13], n[14], n[15], n[16], n[17], n[18], n[19], n[20])  # fmt: skip


@merged
def obey(s, ego, progress):
    """``ControlledVehicle.act`` of a meta-action, but for the steering: it is decided again.

    The vehicle that needs Python to follow the road, or DONE.
    """
    if not progress[RESUMED] and follow_road(s, ego) == ASK_PYTHON:
        progress[RESUMED] = 1
        return ego
    change_lane(s, ego, progress[COMMAND])
    progress[RESUMED] = 0
    progress[COMMAND] = NOTHING
    return DONE


@merged
def act_all(s, progress):
    """``Road.act``. The vehicle that needs Python to follow the road, or DONE."""
    while progress[DRIVER] < s.n:
        i = progress[DRIVER]
        driver = s.vehicles[i]
        if driver.kind == LINEAR and driver.collects and not progress[RESUMED]:
            collect(s, i, progress[SAMPLES])
            progress[SAMPLES] += 1
        if acts(driver):
            if not progress[RESUMED] and follow_road(s, i) == ASK_PYTHON:
                progress[RESUMED] = 1
                return i
            drive(s, i)
        progress[RESUMED] = 0
        progress[DRIVER] += 1
    return DONE


@compiled
def is_finite(v):
    """No state of a vehicle is NaN or so large that a product of some could be infinite."""
    total = abs(v.x) + abs(v.y) + abs(v.heading) + abs(v.speed) + abs(v.steering)
    total += abs(v.acceleration) + abs(v.target_speed) + abs(v.timer) + abs(v.impact_x)
    total += abs(v.impact_y) + abs(v.lateral_speed) + abs(v.yaw_rate)
    return total < LARGEST


@merged
def advance(s, ego, progress, frames, dt, rules_every, road_steps, patience):
    """The sub-steps of one environment. DONE, the vehicle that Python has to help, NOT_FINITE."""
    if progress[FRAME] == 0 and progress[DRIVER] == 0 and not progress[RESUMED]:
        for i in range(s.m):
            if not is_finite(s.vehicles[i]):
                return NOT_FINITE
        for i in range(s.m):
            locate(s, i)
        forget_ranks(s)
    if progress[COMMAND] != NOTHING:
        waiting = obey(s, ego, progress)
        if waiting != DONE:
            return waiting
    by_x, pairs = np.arange(s.m), np.empty(4 * s.m, np.int64)
    while progress[FRAME] < frames:
        waiting = act_all(s, progress)
        if waiting != DONE:
            return waiting
        progress[FRAME] += 1
        progress[DRIVER] = 0
        if rules_every > 0 and (road_steps + progress[FRAME]) % rules_every == 0:
            enforce_road_rules(s, patience)
        for i in range(s.n):
            step(s, i, dt)
        forget_ranks(s)
        collide_all(s, dt, by_x, pairs)
    return DONE


@compiled
def scene_of(
    e, vehicles, counts, routes, lanes, lon, lat, seats, ranks, ranked, link_start, link_lane,
    link_offset, exits, poses, widths, samples, numerics
):  # fmt: skip
    """The scene of environment e."""
    return Scene(
        borrowed(vehicles[e]), borrowed(lanes), borrowed(lon), borrowed(lat), borrowed(seats),
        borrowed(ranks), borrowed(ranked), borrowed(link_start), borrowed(link_lane),
        borrowed(link_offset), borrowed(exits), borrowed(poses), borrowed(widths),
        borrowed(routes[e]), borrowed(samples), counts[e, VEHICLES], counts[e, ITEMS],
        unpack(numerics),
    )  # fmt: skip


@cached
def run(
    vehicles, counts, routes, lanes, lon, lat, seats, ranks, ranked, link_start, link_lane,
    link_offset, exits, poses, widths, samples, numerics,
    progress, first, last, frames, dt, rules_every, patience
):  # fmt: skip
    """Sub-steps of the environments ``first`` to ``last`` - 1, until ``frames`` are done (DONE).

    Or until a vehicle of one of them, which is RESUMED in its ``progress``, has to follow the road:
    its number is returned; call again after Python did it. NOT_FINITE if there is NaN or infinity
    in the vehicles of one; then nothing was done to it.

    vehicles [E, m + 1], routes [E, m, R, 2]: as in ``Scene``, for each environment. counts [E, 4]:
    see VEHICLES. progress [E, 5]: zeros, but for the COMMAND to the vehicle EGO; an environment
    with ``frames`` as its FRAME is left alone. rules_every: sub-steps between checks of the road
    rules, 0 for a plain road; ROAD_STEPS and patience belong to them.
    """
    for e in range(first, last):
        if progress[e, FRAME] >= frames:
            continue
        s = scene_of(
            e, vehicles, counts, routes, lanes, lon, lat, seats, ranks, ranked, link_start,
            link_lane, link_offset, exits, poses, widths, samples, numerics,
        )  # fmt: skip
        waiting = advance(
            s, counts[e, EGO], borrowed(progress[e]), frames, dt, rules_every,
            counts[e, ROAD_STEPS], patience,
        )  # fmt: skip
        if waiting != DONE:
            return waiting
    return DONE


def tables(lanes: int, items: int) -> tuple[np.ndarray, ...]:
    """Room for lon, lat, seats, ranks and ranked of one scene at a time."""
    shape = lanes, items
    return (*np.empty((3, *shape)), np.empty(shape, np.int64), np.empty(lanes, np.int64))


def run_nothing() -> None:
    """One call of ``run`` on an empty road, to have it compiled or loaded."""
    integers, numbers = np.zeros(1, np.int64), np.zeros(1)
    run(
        np.zeros((1, 1), VEHICLE), np.zeros((1, EGO + 1), np.int64),
        np.zeros((1, 1, 1, 2), np.int64), np.zeros(1, LANE), *tables(1, 0),
        np.zeros(2, np.int64), integers, numbers, integers,
        np.zeros((1, len(POSE_COLUMNS))), numbers, np.zeros((1, SAMPLE_COLUMNS)),
        np.zeros(len(Numerics._fields), np.int64), np.zeros((1, COMMAND + 1), np.int64),
        0, 1, 0, 0.1, 0, 0.0,
    )  # fmt: skip


@cached
def check(numerics, inputs, outputs):
    """What ``numerics._truth`` computes with NumPy, computed as the kernels do."""
    np_ = unpack(numerics)
    corners = np.empty((5, 2))
    for row in range(len(inputs)):
        angle, part, x, y, exponent = inputs[row]
        out = outputs[row]
        c, s = cos(np_, angle), sin(np_, angle)
        out[0], out[1] = s, c
        out[2] = tan(np_, angle)
        out[3] = arcsin(np_, part)
        out[4] = arctan(np_, x)
        out[5] = arctan2(np_, x, y)
        out[6] = power(np_, abs(y), exponent)
        out[7] = square(np_, x)
        out[8] = libm(np_.libm_pow, x, 2.0)
        out[9], out[10] = libm_of(np_.libm_sin, angle), libm_of(np_.libm_cos, angle)
        out[11] = wrap_to_pi(x)
        out[12] = dot(np_.dot, x, y, part, angle)
        out[13] = dot3(np_.dot, angle, part, exponent, x, y, part)
        out[14] = sqrt(dot(np_.dot, x, y, x, y))
        out[15] = dot(np_.matrix_vector, c, -s, x, y)
        out[16] = dot(np_.matrix_vector, s, c, x, y)
        rectangle(np_, 0.0, 0.0, x, y, c, s, corners)
        for index in range(4):
            out[17 + 2 * index], out[18 + 2 * index] = corners[index]
        for index in range(9):
            u, v = corner_offsets(index, x, y)
            out[25 + 2 * index] = dot(np_.matrix_matrix, c, -s, u, v) + 0.0
            out[26 + 2 * index] = dot(np_.matrix_matrix, s, c, u, v) + 0.0
