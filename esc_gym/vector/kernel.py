"""What a step of a batch does around the sub-steps: decide, judge, begin anew, observe."""

from __future__ import annotations

from types import FunctionType
from typing import Any, NamedTuple

import numpy as np

from esc_gym.fastsim.cache import cached
from esc_gym.fastsim.kernel import COMMAND, EGO, FRAME, ITEMS, ROAD_STEPS, VEHICLES, scene_of
from esc_gym.fastsim.numerics import compiled
from esc_gym.fastsim.records import IDM, MDP
from esc_gym.vector.measures import Measured, measure
from esc_gym.vector.observe import Output, Spec, observe
from esc_gym.vector.state import ENDED, ROAD, RUNNING, SHUFFLE

TERMINATED, TRUNCATED = range(2)
# What ``look_all`` measures.
NOTHING, DRIVING, COLLISIONS = range(3)


class Told(NamedTuple):
    """What ``info`` says of E environments: speed [E], crashed [E], rewards [E, K] by name."""

    speed: np.ndarray
    crashed: np.ndarray
    rewards: np.ndarray


@compiled
def speed_index(speed, target_speeds):
    """``MDPVehicle.speed_to_index``."""
    last = len(target_speeds) - 1
    x = (speed - target_speeds[0]) / (target_speeds[last] - target_speeds[0])
    return np.int64(min(max(np.rint(x * last), 0.0), np.float64(last)))


@cached
def decide(
    vehicles, counts, heads, progress, actions, commands, speed_steps, target_speeds, controls,
    speed_range, frames
):  # fmt: skip
    """Begin a step: take the actions, and leave alone the environments that are to be reset.

    actions [E]: numbers of meta-actions; commands, speed_steps [A]: what each asks for.
    controls [E, 2]: steering and acceleration of an ego that takes no meta-actions; speed_range:
    what its first action limits it to, inf and -inf for nothing.
    """
    for e in range(len(heads)):
        for entry in range(COMMAND + 1):
            progress[e, entry] = 0
        if heads[e].over:
            progress[e, FRAME] = frames
            continue
        me = vehicles[e, counts[e, EGO]]
        if me.kind == IDM:  # nobody commands it
            continue
        if me.kind != MDP:
            me.steering, me.acceleration = controls[e, 0], controls[e, 1]
            if speed_range[0] <= speed_range[1]:
                me.min_speed, me.max_speed = speed_range[0], speed_range[1]
            continue
        action = actions[e]
        progress[e, COMMAND] = commands[action]
        if speed_steps[action] != 0:
            index = speed_index(me.speed, target_speeds) + speed_steps[action]
            index = min(max(index, 0), len(target_speeds) - 1)
            me.target_speed = target_speeds[index]


@cached
def look_all(
    vehicles, counts, routes, lanes, lon, lat, seats, ranks, ranked, link_start, link_lane,
    link_offset, exits, poses, widths, samples, numerics, ids, heads, generators,
    reach, rules, columns, center, half, ego_columns, ego_center, ego_half, virtual, goal_scales,
    ego, others, mask, out_ids, out_counts, achieved, desired, told_speed, told_crashed,
    speed, crashed, along, is_on_road, road, lane, time, chosen, observing, measuring, first, last
):  # fmt: skip
    """Observe and measure the environments that are ``chosen`` [E].

    See ``Spec``, ``Output`` and ``Measured``. measuring: NOTHING, DRIVING, or COLLISIONS, too.
    """
    spec = Spec(
        reach, rules, columns, center, half, ego_columns, ego_center, ego_half, virtual, goal_scales
    )
    out = Output(ego, others, mask, out_ids, out_counts, achieved, desired)
    measured = Measured(speed, crashed, along, is_on_road, road, lane, time)
    for e in range(first, last):
        if not chosen[e]:
            continue
        s = scene_of(
            e, vehicles, counts, routes, lanes, lon, lat, seats, ranks, ranked, link_start,
            link_lane, link_offset, exits, poses, widths, samples, numerics,
        )  # fmt: skip
        me, head = counts[e, EGO], heads[e]
        if observing:
            head.next_id = observe(
                s, me, e, spec, generators[e, SHUFFLE], ids[e], head.lane, head.next_id, out
            )
            told_speed[e], told_crashed[e] = s.vehicles[me].speed, s.vehicles[me].crashed
        if measuring != NOTHING:
            measure(s, me, e, measured, measuring == COLLISIONS)


inner: Any = None  # of ``_forward``: each entry has its own


def _forward(*arguments: Any) -> None:
    inner(*arguments)


def entry(of: Any, compiled_function: Any) -> Any:
    """A cached function that calls another, named after a family's function ``of``.

    Numba keeps no closures on disk: this one has what it calls in globals of its own.
    """
    source = of.py_func
    function: Any = FunctionType(_forward.__code__, {"inner": compiled_function})
    function.__module__ = source.__module__
    function.__qualname__ = f"{source.__module__}.{source.__name__}_all"
    return cached(function)


def judging(judge: Any) -> Any:
    """Rewards and ends of all environments that are RUNNING, by their family's ``judge``.

    judge(s, ego, head, action, constants, parts): (reward, terminated, truncated), and the rewards
    by name into ``parts``. action: the number of a meta-action, or the norm of another; -1 at a
    reset.
    period: of a policy step [s]. limit: policy steps until an episode is cut short, 0 for none.
    """

    @compiled
    def judge_all(
        vehicles, counts, routes, lanes, lon, lat, seats, ranks, ranked, link_start, link_lane,
        link_offset, exits, poses, widths, samples, numerics,
        heads, constants, parts, rewards, ends, sizes, first, last, frames, period, limit
    ):  # fmt: skip
        for e in range(first, last):
            head = heads[e]
            rewards[e], ends[e, TERMINATED], ends[e, TRUNCATED] = 0.0, 0, 0
            if head.over != RUNNING:
                continue
            s = scene_of(
                e, vehicles, counts, routes, lanes, lon, lat, seats, ranks, ranked, link_start,
                link_lane, link_offset, exits, poses, widths, samples, numerics,
            )  # fmt: skip
            head.time += period
            head.steps += frames
            head.elapsed += 1
            reward, terminated, truncated = judge(
                s, counts[e, EGO], head, sizes[e], constants, parts[e]
            )
            truncated = truncated or (limit > 0 and head.elapsed >= limit)
            rewards[e], ends[e, TERMINATED], ends[e, TRUNCATED] = reward, terminated, truncated
            if terminated or truncated:
                head.over = ENDED

    return entry(judge, judge_all)


def beginning(reset: Any, judge: Any) -> Any:
    """New scenes in the environments that are ``chosen`` [E], by their family's ``reset``.

    reset(s, ego, generator, constants, ranges, plans, lengths, template): makes a scene of the
    vehicles of ``template``, which are there, and says how many there are; the objects come after
    them. judge: of ``judging``.
    """

    @compiled
    def begin_all(
        vehicles, counts, routes, lanes, lon, lat, seats, ranks, ranked, link_start, link_lane,
        link_offset, exits, poses, widths, samples, numerics,
        ids, heads, generators, template, constants, ranges, plans, lengths, parts, chosen,
        first, last
    ):  # fmt: skip
        for e in range(first, last):
            if not chosen[e]:
                continue
            head, ego = heads[e], counts[e, EGO]
            head.time = 0.0
            head.steps = head.elapsed = head.over = head.next_id = 0
            counts[e, ROAD_STEPS] = 0
            for i in range(ids.shape[1]):
                ids[e, i] = -1
            for i in range(len(template)):
                vehicles[e, i] = template[i]
            objects = counts[e, ITEMS] - counts[e, VEHICLES]
            counts[e, ITEMS] = len(template) - 1
            counts[e, VEHICLES] = counts[e, ITEMS] - objects
            for again in range(2):
                s = scene_of(
                    e, vehicles, counts, routes, lanes, lon, lat, seats, ranks, ranked, link_start,
                    link_lane, link_offset, exits, poses, widths, samples, numerics,
                )  # fmt: skip
                if again:
                    judge(s, ego, head, -1.0, constants, parts[e])
                    break
                n = reset(s, ego, generators[e, ROAD], constants, ranges, plans, lengths, template)
                if n < s.n:
                    for i in range(objects):
                        s.vehicles[n + i] = template[s.n + i]
                counts[e, VEHICLES], counts[e, ITEMS] = n, n + objects

    return entry(reset, begin_all)


def changing(change: Any, judge: Any) -> Any:
    """Vehicles that come and go in the environments that are ``chosen`` [E].

    change(s, ego, generator, constants, ranges, plans, lengths, template, ids): does it, and says
    (how many there are, which of them is the ego). judge: of ``judging``, for the rewards by name.
    """

    @compiled
    def change_all(
        vehicles, counts, routes, lanes, lon, lat, seats, ranks, ranked, link_start, link_lane,
        link_offset, exits, poses, widths, samples, numerics,
        ids, heads, generators, template, constants, ranges, plans, lengths, parts, chosen,
        first, last
    ):  # fmt: skip
        for e in range(first, last):
            if not chosen[e]:
                continue
            for again in range(2):
                s = scene_of(
                    e, vehicles, counts, routes, lanes, lon, lat, seats, ranks, ranked, link_start,
                    link_lane, link_offset, exits, poses, widths, samples, numerics,
                )  # fmt: skip
                if again:
                    judge(s, counts[e, EGO], heads[e], -1.0, constants, parts[e])
                    break
                n, ego = change(
                    s, counts[e, EGO], generators[e, ROAD], constants, ranges, plans, lengths,
                    template, ids[e],
                )  # fmt: skip
                counts[e, VEHICLES], counts[e, ITEMS], counts[e, EGO] = n, n, ego

    return entry(change, change_all)


@compiled
def unjudged(s, ego, head, action, constants, parts):
    """A ``judge`` for scenes that are not ready."""
    return 0.0, False, False
