"""intersection-v0, intersection-v1 and intersection-v2 (``envs/intersection_env.py``)."""

from __future__ import annotations

from typing import Any

import numpy as np
from highway_env.envs.intersection_env import (
    ConnectedLaneIntersectionEnv,
    ContinuousIntersectionEnv,
    IntersectionEnv,
)

from esc_gym.fastsim.geometry import heading_at, local_coordinates, position
from esc_gym.fastsim.known import Repeated
from esc_gym.fastsim.numerics import clip, compiled, outlined
from esc_gym.fastsim.records import CONTROLLED
from esc_gym.scenarios import scenario_of
from esc_gym.vector.generators import below, normal, random
from esc_gym.vector.kernel import beginning, changing, judging, unjudged
from esc_gym.vector.scenes.roads import (
    create,
    distance,
    lmap,
    make_on_lane,
    on_road,
    plan,
    randomize,
    weighted,
    weights,
)

CLASSES = (IntersectionEnv, ConnectedLaneIntersectionEnv, ContinuousIntersectionEnv)
REWARDS = {
    "collision_reward": float, "high_speed_reward": float, "arrived_reward": float,
    "on_road_reward": float,
}  # fmt: skip
COLLISION, HIGH_SPEED, ARRIVED, ON_ROAD, OF_AGENT, AGENT_ENDS = range(6)
# What info says for each agent, of which there is one: the column, and its type.
EXTRAS = {"agents_rewards": float, "agents_terminated": bool}
DESTINATIONS = ("o0", "o1", "o2", "o3")
REPEATED = Repeated(
    "7de574101018f228ebaed8f9d3f47b9424a2e97f5970b8a35ec47d68ce04734b",
    (IntersectionEnv, "_reset step _make_road _make_vehicles _spawn_vehicle _clear_vehicles"),
    (IntersectionEnv, "_reward _rewards _agent_reward _agent_rewards _agent_is_terminal"),
    (IntersectionEnv, "_is_terminated _is_truncated _info has_arrived"),
)
# Entries of the constants after ``weights``; then the four incoming lanes, for every
# lane whether it leads out, and where the first vehicles come.
(
    SLOW, FAST, NORMALIZE, OFFROAD_TERMINAL, DURATION, SPAWNING, GOING, INITIAL, INCOMING,
) = range(5, 14)  # fmt: skip
OUT = INCOMING + 4


def unknown(env: Any) -> str:
    """Why the engine cannot do this configuration; "" if it can."""
    config = env.config
    low, high = config["reward_speed_range"]
    same = config["collision_reward"] == config["arrived_reward"]
    if low == high or (config["normalize_reward"] and same):
        return "a reward whose range is empty"
    if config["destination"] and config["destination"] not in DESTINATIONS:
        return "a destination that is none"
    if config["simulation_frequency"] != int(config["simulation_frequency"]):
        return "a simulation_frequency that is not whole"
    return "" if env.action_type.__class__.__name__ != "DiscreteAction" else "DiscreteAction"


def capacity(env: Any) -> int:
    """The most vehicles that there can be: one more may come in the step after the last."""
    return scenario_of(env).capacity(env.config) + 3


def constants(env: Any, network: Any) -> list[float]:
    """The configuration as numbers."""
    config, going = env.config, env.config["destination"]
    return [
        *weights(config, REWARDS), *config["reward_speed_range"],
        config["normalize_reward"], config["offroad_terminal"], config["duration"],
        config["spawn_probability"], DESTINATIONS.index(going) if going else -1,
        config["initial_vehicle_count"],
        *(network.numbers[f"o{corner}", f"ir{corner}", 0] for corner in range(4)),
        *("il" in start and "o" in end for start, end, _ in network.indexes),
        *np.linspace(0, 80, config["initial_vehicle_count"]),
    ]  # fmt: skip


def warm_up(env: Any) -> int:
    """Sub-steps between ``reset`` and ``complete``."""
    return 3 * int(env.config["simulation_frequency"])


@outlined
def spawn(s, n, g, c, ranges, plans, lengths, template, along, spread, slower, likely, straight):
    """``IntersectionEnv._spawn_vehicle``: vehicle n comes, or does not; how many there are."""
    if random(g) > likely:
        return n
    start = below(g, 3)
    end = below(g, 4)
    end = 3 if end == start else end
    if below(g, 2) == 0:
        start, end = end, start
    end = (start + 2) % 4 if straight else end
    s.vehicles[n] = template[0]
    along = along + 5.0 + normal(g) * spread
    make_on_lane(s, n, np.int64(c[INCOMING + start]), along, 8.0 + normal(g) * slower)
    me = s.vehicles[n]
    for i in range(n):
        if distance(s, s.vehicles[i].x, s.vehicles[i].y, me.x, me.y) < 15:
            return n
    plan(s, n, end, plans, lengths)
    randomize(s, n, g, ranges)
    return n + 1


@outlined
def reset(s, ego, g, c, ranges, plans, lengths, template):
    """The first part of ``_make_vehicles``, up to the sub-steps; how many vehicles there are."""
    n = 0
    for i in range(np.int64(c[INITIAL]) - 1):
        place = c[OUT + len(s.lanes) + i]
        n = spawn(s, n, g, c, ranges, plans, lengths, template, place, 1.0, 1.0, 0.6, False)
    return n


@compiled
def move(s, i, j, ids):
    """Vehicle i becomes vehicle j, of a lower number."""
    if i == j:
        return
    s.vehicles[j] = s.vehicles[i]
    ids[j] = ids[i]
    for step in range(s.routes.shape[1]):
        s.routes[j, step, 0] = s.routes[i, step, 0]
        s.routes[j, step, 1] = s.routes[i, step, 1]


@outlined
def complete(s, ego, g, c, ranges, plans, lengths, template, ids):
    """The second part of ``_make_vehicles``: (how many vehicles there are, which is the ego)."""
    n = spawn(s, s.n, g, c, ranges, plans, lengths, template, 60.0, 0.1, 0.0, 1.0, True)
    lane = np.int64(c[INCOMING])
    going = np.int64(c[GOING]) if c[GOING] >= 0 else 1 + below(g, 3)
    x, y = position(s, lane, 60.0 + 5.0 * (1.0 + 1.0 * normal(g)))
    s.vehicles[n] = template[len(template) - 2]
    create(s, n, x, y, heading_at(s, lane, 60.0), s.lanes[lane].speed_limit)
    s.vehicles[n].route_length = s.vehicles[n].route_taken = 0
    if s.vehicles[n].kind >= CONTROLLED:
        plan(s, n, going, plans, lengths)
    kept = 0
    for i in range(n + 1):
        other = s.vehicles[i]
        if i == n or not distance(s, other.x, other.y, x, y) < 20:
            move(s, i, kept, ids)
            kept += 1
    return kept, kept - 1


@compiled
def out_at(s, i, c):
    """How far vehicle i is on a lane that leads out; -inf on others."""
    me = s.vehicles[i]
    if not c[OUT + me.lane]:
        return -np.inf
    return local_coordinates(s, me.lane, me.x, me.y)[0]


@outlined
def go_on(s, ego, g, c, ranges, plans, lengths, template, ids):
    """After the observation: ``_clear_vehicles``, ``_spawn_vehicle``; as of ``complete``."""
    kept = me = 0
    for i in range(s.n):
        vehicle = s.vehicles[i]
        gone = out_at(s, i, c) >= s.lanes[vehicle.lane].length - 4 * vehicle.length
        if i == ego or not gone:
            me = kept if i == ego else me
            move(s, i, kept, ids)
            kept += 1
    ids[kept] = -1
    n = spawn(s, kept, g, c, ranges, plans, lengths, template, 0.0, 1.0, 1.0, c[SPAWNING], False)
    return n, me


@outlined
def judge(s, ego, head, action, c, parts):
    """``IntersectionEnv._reward``, ``_is_terminated``, ``_is_truncated``."""
    me = s.vehicles[ego]
    is_on_road, arrived = on_road(s, ego), out_at(s, ego, c) >= 25
    parts[COLLISION] = me.crashed
    parts[HIGH_SPEED] = clip(lmap(me.speed, c[SLOW], c[FAST], 0, 1), 0.0, 1.0)
    parts[ARRIVED] = 1.0 if arrived else 0.0
    parts[ON_ROAD] = 1.0 if is_on_road else 0.0
    reward = c[ARRIVED] if arrived else weighted(parts[:4], c, 1)
    reward *= parts[ON_ROAD]
    if c[NORMALIZE]:
        reward = lmap(reward, c[COLLISION], c[ARRIVED], 0, 1)
    parts[OF_AGENT], parts[AGENT_ENDS] = reward, 1.0 if me.crashed or arrived else 0.0
    terminated = me.crashed or arrived or (c[OFFROAD_TERMINAL] and not is_on_road)
    return 0.0 + reward, terminated, head.time >= c[DURATION]  # a sum: never -0.0


judge_all, begin_all = judging(judge), beginning(reset, unjudged)
complete_all, go_on_all = changing(complete, judge), changing(go_on, unjudged)
