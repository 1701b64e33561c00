"""merge-v0, merge-v1, merge-generic-v0 and merge-generic-v1 (``envs/merge_env.py``)."""

from __future__ import annotations

from typing import Any

import numpy as np
from highway_env.envs.merge_env import (
    ConnectedLaneMergeEnv,
    ConnectedLaneMergeGenericEnv,
    MergeEnv,
    MergeGenericEnv,
)

from esc_gym.fastsim.geometry import position
from esc_gym.fastsim.known import Repeated
from esc_gym.fastsim.numerics import compiled, outlined
from esc_gym.fastsim.records import CONTROLLED
from esc_gym.vector.generators import below, uniform
from esc_gym.vector.kernel import beginning, judging
from esc_gym.vector.scenes.roads import added, create, lmap, weighted, weights

CLASSES = (MergeEnv, ConnectedLaneMergeEnv, MergeGenericEnv, ConnectedLaneMergeGenericEnv)
META_ONLY = True
REWARDS = {
    "collision_reward": bool, "right_lane_reward": float, "high_speed_reward": float,
    "lane_change_reward": bool, "merging_speed_reward": float,
}  # fmt: skip
COLLISION, RIGHT_LANE, HIGH_SPEED, LANE_CHANGE, MERGING = range(5)
REPEATED = Repeated(
    "9db1bc9831fb1435f1f10c7e355ee4c9c80c5606f9d5b7fff914023f34cd6add",
    (MergeEnv, "_reset _make_road _make_vehicles _reward _rewards _is_terminated _is_truncated"),
    (MergeGenericEnv, "__init__ _make_road _make_vehicles _is_terminated _is_truncated"),
)
# Entries of the constants after ``weights``.
SLOW, FAST, END, PARALLEL, RAMP, GENERIC, LANES, OTHERS, LENGTH = range(6, 15)
SAFE, TRIES = 15.0, 10


def unknown(env: Any) -> str:
    """Why the engine cannot do this configuration; "" if it can."""
    config = env.config
    low, high = config["reward_speed_range"]
    worst = config["collision_reward"] + config["merging_speed_reward"]
    if low == high or worst == config["high_speed_reward"] + config["right_lane_reward"]:
        return "a reward whose range is empty"
    return ""


def capacity(env: Any) -> int:
    """The most vehicles that there can be."""
    return env.config["vehicles_count"] + 2 if isinstance(env, MergeGenericEnv) else 5


def constants(env: Any, network: Any) -> list[float]:
    """The configuration as numbers."""
    config, generic = env.config, isinstance(env, MergeGenericEnv)
    parallel = network.numbers.get(("b", "c", 2), -1)
    sections = "before_merge_length", "converge_merge_length", "parallel_merge_length"
    return [
        *weights(config, REWARDS),
        *config["reward_speed_range"], env.end_position if generic else 370, parallel,
        network.numbers["j", "k", 0], generic,
        *((config["lanes_count"], config["vehicles_count"]) if generic else (2, 3)),
        sum(config[name] for name in sections) if generic else 0,
    ]  # fmt: skip


@compiled
def put(s, i, k, longitudinal, speed):
    """A vehicle on lane k, heading along x."""
    x, y = position(s, k, longitudinal)
    create(s, i, x, y, 0.0, speed)


@compiled
def put_merging(s, i, k, longitudinal):
    """The vehicle on the ramp, the last one."""
    put(s, i, k, longitudinal, 20.0)
    s.vehicles[i].target_speed = 30.0
    return i + 1


@outlined
def populate(s, g, c):
    """``MergeGenericEnv._make_vehicles`` but for the ego; how many vehicles there are."""
    n, lanes = 1, np.int64(c[LANES])
    at, on = np.empty(np.int64(c[OTHERS]) + 1), np.empty(np.int64(c[OTHERS]) + 1, np.int64)
    at[0], on[0] = 30.0, lanes - 1
    for _ in range(np.int64(c[OTHERS])):
        for _ in range(TRIES):
            k = below(g, lanes)
            longitudinal = uniform(g, 0, c[LENGTH])
            safe = True
            for j in range(n):
                safe = safe and (on[j] != k or abs(longitudinal - at[j]) > SAFE)
            if safe:
                put(s, n, k, longitudinal, 30.0 + uniform(g, -2.0, 2.0))
                at[n], on[n] = longitudinal, k
                n += 1
                break
    return put_merging(s, n, np.int64(c[RAMP]), 60.0)


@outlined
def reset(s, ego, g, c, ranges, plans, lengths, template):
    """``_make_vehicles``; how many vehicles there are."""
    put(s, ego, np.int64(c[LANES]) - 1, 30.0, 30.0)
    if c[GENERIC]:
        return populate(s, g, c)
    for i in range(1, 4):
        longitudinal, speed = (90.0, 29.0) if i == 1 else ((70.0, 31.0) if i == 2 else (5.0, 31.5))
        k = below(g, 2)
        longitudinal += uniform(g, -5.0, 5.0)
        put(s, i, k, longitudinal, speed + uniform(g, -1.0, 1.0))
    return put_merging(s, 4, np.int64(c[RAMP]), 110.0)


@outlined
def judge(s, ego, head, action, c, parts):
    """``MergeEnv._reward``, ``_is_terminated``, ``_is_truncated``."""
    me = s.vehicles[ego]
    merging = lost = 0.0
    for i in range(s.n):
        vehicle = s.vehicles[i]
        if vehicle.lane == c[PARALLEL] and vehicle.kind >= CONTROLLED:
            slower = (vehicle.target_speed - vehicle.speed) / vehicle.target_speed
            merging, lost = added(merging, lost, slower)
    parts[COLLISION] = np.float64(me.crashed)
    parts[RIGHT_LANE] = s.lanes[me.lane].id / 1
    parts[HIGH_SPEED] = lmap(me.speed, c[SLOW], c[FAST], 0, 1)
    parts[LANE_CHANGE] = 1.0 if action in (0, 2) else 0.0
    parts[MERGING] = merging + lost
    reward = weighted(parts, c, len(parts))
    worst, best = c[COLLISION] + c[MERGING], c[HIGH_SPEED] + c[RIGHT_LANE]
    terminated = me.crashed != 0 or me.x > c[END]
    return lmap(reward, worst, best, 0, 1), terminated, False


judge_all, begin_all = judging(judge), beginning(reset, judge)
