"""roundabout-v0, -v1, roundabout-generic-v0 and -v1 (``envs/roundabout_env.py``)."""

from __future__ import annotations

from typing import Any

import numpy as np
from highway_env.envs.roundabout_env import (
    ConnectedLaneRoundaboutEnv,
    ConnectedLaneRoundaboutGenericEnv,
    RoundaboutEnv,
    RoundaboutGenericEnv,
)
from highway_env.vehicle.controller import MDPVehicle

from esc_gym.fastsim.geometry import heading_at, position
from esc_gym.fastsim.known import Repeated
from esc_gym.fastsim.numerics import outlined
from esc_gym.vector.generators import below, normal, uniform
from esc_gym.vector.kernel import beginning, judging
from esc_gym.vector.scenes.roads import (
    create,
    distance,
    lmap,
    make_on_lane,
    on_road,
    plan,
    randomize,
    speed_number,
    weighted,
    weights,
)

CLASSES = (
    RoundaboutEnv, ConnectedLaneRoundaboutEnv,
    RoundaboutGenericEnv, ConnectedLaneRoundaboutGenericEnv,
)  # fmt: skip
META_ONLY = True
REWARDS = {
    "collision_reward": bool, "high_speed_reward": float, "lane_change_reward": bool,
    "on_road_reward": bool,
}  # fmt: skip
COLLISION, HIGH_SPEED, LANE_CHANGE, ON_ROAD = range(4)
DESTINATIONS = ("exr", "sxr", "nxr", "wxr", "nxs")
TO_EGO = DESTINATIONS.index("nxs")
REPEATED = Repeated(
    "423a048fb1dfe0ef9301b2386ba588cffa964bc19ab00b9b0c5f85bb4c97ad6b",
    (RoundaboutEnv, "_reset _make_road _make_vehicles _reward _rewards _is_terminated"),
    (RoundaboutEnv, "_is_truncated"),
    (RoundaboutGenericEnv, "_make_road _make_vehicles"),
    (MDPVehicle, "get_speed_index"),
)
# Roads on which the generic one places vehicles, in its order.
SPAWN = (
    ("we", "sx"), ("sx", "se"), ("ee", "nx"), ("nx", "ne"),
    ("eer", "ees"), ("ner", "nes"), ("wer", "wes"),
)  # fmt: skip
# Entries of the constants after ``weights``; then the roads above, target speeds.
NORMALIZE, DURATION, START, INNER, OUTER, ENTRY, GENERIC, OTHERS, GOING, ROADS = range(5, 15)
SPEEDS = ROADS + len(SPAWN)
SAFE, TRIES = 7.0, 10


def unknown(env: Any) -> str:
    """Why the engine cannot do this configuration; "" if it can."""
    config = env.config
    if config["normalize_reward"] and config["collision_reward"] == config["high_speed_reward"]:
        return "a reward whose range is empty"
    going, generic = config["incoming_vehicle_destination"], isinstance(env, RoundaboutGenericEnv)
    if going is not None and not 0 <= going < (len(DESTINATIONS) if generic else 3):
        return "an incoming_vehicle_destination that is none"
    return ""


def capacity(env: Any) -> int:
    """The most vehicles that there can be."""
    return env.config["vehicles_count"] + 1 if isinstance(env, RoundaboutGenericEnv) else 5


def constants(env: Any, network: Any) -> list[float]:
    """The configuration as numbers."""
    config, number = env.config, network.numbers
    generic, going = isinstance(env, RoundaboutGenericEnv), config["incoming_vehicle_destination"]
    return [
        *weights(config, REWARDS),
        config["normalize_reward"], config["duration"], number["ser", "ses", 0],
        number["we", "sx", 0], number.get(("we", "sx", 1), -1), number["eer", "ees", 0],
        generic, config.get("vehicles_count", 4), -1 if going is None else min(going, 3),
        *(number[start, end, 0] for start, end in SPAWN), *env.action_type.target_speeds,
    ]  # fmt: skip


@outlined
def populate(s, g, c, ranges, plans, lengths):
    """``RoundaboutGenericEnv._make_vehicles`` but for the ego; how many vehicles there are."""
    n = 1
    for _ in range(np.int64(c[OTHERS])):
        for _ in range(TRIES):
            road = np.int64(c[ROADS + below(g, len(SPAWN))])
            k = road + below(g, s.lanes[road].count)
            longitudinal = uniform(g, 5.0, max(5.0, s.lanes[k].length - 5.0))
            x, y = position(s, k, longitudinal)
            safe = True
            for j in range(n):
                safe = safe and not distance(s, x, y, s.vehicles[j].x, s.vehicles[j].y) < SAFE
            if safe:
                make_on_lane(s, n, k, longitudinal, 14.0 + normal(g) * 2.0)
                going = np.int64(c[GOING]) if c[GOING] >= 0 else below(g, 4)
                plan(s, n, going, plans, lengths)
                randomize(s, n, g, ranges)
                n += 1
                break
    return n


@outlined
def reset(s, ego, g, c, ranges, plans, lengths, template):
    """``_make_vehicles``; how many vehicles there are."""
    start = np.int64(c[START])
    along = s.lanes[start].length - 2.5 if c[GENERIC] else 125.0
    x, y = position(s, start, along)
    create(s, ego, x, y, heading_at(s, start, along), 8.0)
    plan(s, ego, TO_EGO, plans, lengths)
    if c[GENERIC]:
        return populate(s, g, c, ranges, plans, lengths)
    for i in range(1, 5):
        lane, along = (c[OUTER], 5.0) if i == 1 else (c[INNER], 20.0 if i == 2 else -20.0)
        if i == 4:
            lane, along = c[ENTRY], 50.0
        along += normal(g) * 2.0
        make_on_lane(s, i, np.int64(lane), along, 16.0 + normal(g) * 2.0)
        going = np.int64(c[GOING]) if i == 1 and c[GOING] >= 0 else below(g, 3)
        plan(s, i, going, plans, lengths)
        randomize(s, i, g, ranges)
    return 5


@outlined
def judge(s, ego, head, action, c, parts):
    """``RoundaboutEnv._reward``, ``_is_terminated``, ``_is_truncated``."""
    me = s.vehicles[ego]
    parts[COLLISION] = me.crashed
    parts[HIGH_SPEED] = speed_number(s, ego, c[SPEEDS:]) / 2  # DEFAULT_TARGET_SPEEDS.size - 1
    parts[LANE_CHANGE] = 1.0 if action in (0, 2) else 0.0
    parts[ON_ROAD] = 1.0 if on_road(s, ego) else 0.0
    reward = weighted(parts, c, 4)
    if c[NORMALIZE]:
        reward = lmap(reward, c[COLLISION], c[HIGH_SPEED], 0, 1)
    return reward * parts[ON_ROAD], me.crashed != 0, head.time >= c[DURATION]


judge_all, begin_all = judging(judge), beginning(reset, judge)
