"""highway-v0 and highway-fast-v0 (``envs/highway_env.py``)."""

from __future__ import annotations

from typing import Any

import numpy as np
from highway_env.envs.highway_env import HighwayEnv, HighwayEnvFast

from esc_gym.fastsim.known import Repeated
from esc_gym.fastsim.numerics import clip, cos, outlined
from esc_gym.vector.generators import below
from esc_gym.vector.kernel import beginning, judging
from esc_gym.vector.scenes.roads import (
    create_random,
    lmap,
    on_road,
    randomize,
    wanted_lane,
    weighted,
    weights,
)

CLASSES = (HighwayEnv, HighwayEnvFast)
REWARDS = {
    "collision_reward": float, "right_lane_reward": float, "high_speed_reward": float,
    "on_road_reward": float,
}  # fmt: skip
COLLISION, RIGHT_LANE, HIGH_SPEED, ON_ROAD = range(4)
REPEATED = Repeated(
    "55faa1def9ac7252366a5b8c0629724a546aed518d53dfa1f2e5e5c2bbad2e38",
    (HighwayEnv, "_reset _create_road _create_vehicles"),
    (HighwayEnv, "_reward _rewards _is_terminated _is_truncated"),
    (HighwayEnvFast, "_create_vehicles"),
)
# Entries of the constants after ``weights``.
NORMALIZE, SLOW, FAST, OFFROAD_TERMINAL, DURATION, LANE, SPACING, OTHERS, DENSITY = range(5, 14)


def unknown(env: Any) -> str:
    """Why the engine cannot do this configuration; "" if it can."""
    config = env.config
    low, high = config["reward_speed_range"]
    best = config["high_speed_reward"] + config["right_lane_reward"]
    if low == high or (config["normalize_reward"] and best == config["collision_reward"]):
        return "a reward whose range is empty"
    lane = config["initial_lane_id"]
    if lane is not None and not 0 <= lane < config["lanes_count"]:
        return "an initial_lane_id that is no lane"
    return ""


def constants(env: Any, network: Any) -> list[float]:
    """The configuration as numbers."""
    config, lane = env.config, env.config["initial_lane_id"]
    return [
        *weights(config, REWARDS),
        config["normalize_reward"], *config["reward_speed_range"], config["offroad_terminal"],
        config["duration"], -1 if lane is None else lane, config["ego_spacing"],
        1 / config["vehicles_density"], np.exp(-5 / 40 * config["lanes_count"]),
    ]  # fmt: skip


@outlined
def reset(s, ego, g, c, ranges, plans, lengths, template):
    """``HighwayEnv._create_vehicles``; how many vehicles there are."""
    lanes = s.lanes[0].count
    lane = np.int64(c[LANE]) if c[LANE] >= 0 else below(g, lanes)
    create_random(s, ego, g, lane, 25.0, c[SPACING], c[DENSITY])
    for i in range(1, s.n):
        create_random(s, i, g, below(g, lanes), np.nan, c[OTHERS], c[DENSITY])
        randomize(s, i, g, ranges)
    return s.n


@outlined
def judge(s, ego, head, action, c, parts):
    """``HighwayEnv._reward``, ``_is_terminated``, ``_is_truncated``."""
    me = s.vehicles[ego]
    is_on_road = on_road(s, ego)
    speed = lmap(me.speed * cos(s.np, me.heading), c[SLOW], c[FAST], 0, 1)
    parts[COLLISION] = np.float64(me.crashed)
    parts[RIGHT_LANE] = s.lanes[wanted_lane(s, ego)].id / max(s.lanes[me.lane].count - 1, 1)
    parts[HIGH_SPEED] = clip(speed, 0.0, 1.0)
    parts[ON_ROAD] = 1.0 if is_on_road else 0.0
    reward = weighted(parts, c, 2)
    if c[NORMALIZE]:
        reward = lmap(reward, c[COLLISION], c[HIGH_SPEED] + c[RIGHT_LANE], 0, 1)
    reward *= parts[ON_ROAD]
    terminated = me.crashed or (c[OFFROAD_TERMINAL] and not is_on_road)
    return reward, terminated, head.time >= c[DURATION]


judge_all, begin_all = judging(judge), beginning(reset, judge)
