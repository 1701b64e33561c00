"""highway-v0 and highway-fast-v0 (``envs/highway_env.py``)."""

from __future__ import annotations

from typing import Any

import numpy as np
from highway_env.envs.highway_env import HighwayEnv, HighwayEnvFast

from esc_gym.fastsim.cache import cached
from esc_gym.fastsim.known import Repeated
from esc_gym.fastsim.numerics import clip, cos, outlined
from esc_gym.vector.kernel import settling
from esc_gym.vector.scenes.roads import (
    appear_at_random,
    lane_number,
    lmap,
    on_road,
    randomize,
)

CLASSES = (HighwayEnv, HighwayEnvFast)
REWARDS = ("collision_reward", "right_lane_reward", "high_speed_reward", "on_road_reward")
REPEATED = Repeated(
    "55faa1def9ac7252366a5b8c0629724a546aed518d53dfa1f2e5e5c2bbad2e38",
    (HighwayEnv, "_reset _create_road _create_vehicles"),
    (HighwayEnv, "_reward _rewards _is_terminated _is_truncated"),
    (HighwayEnvFast, "_create_vehicles"),
)
COLLISION, RIGHT_LANE, HIGH_SPEED, ON_ROAD = range(4)
# Entries of ``constants`` after the weights of the rewards and the six ranges of behaviour.
NORMALIZE, SLOW, FAST, OFFROAD_TERMINAL, DURATION, LANE, SPACING, OTHERS, DENSITY = range(4, 13)
RANGES = 13


def unknown(env: Any) -> str:
    """Why the engine cannot do this configuration; "" if it can."""
    config = env.config
    low, high = config["reward_speed_range"]
    best = config["high_speed_reward"] + config["right_lane_reward"]
    if low == high or (config["normalize_reward"] and best == config["collision_reward"]):
        return "a reward whose range is empty"
    if config["initial_lane_id"] is not None and not (
        0 <= config["initial_lane_id"] < config["lanes_count"]
    ):
        return "an initial_lane_id that is no lane"
    return ""


def constants(env: Any, ranges: np.ndarray) -> np.ndarray:
    """The configuration as numbers; ranges [6, 2]: see ``roads.randomize``."""
    config, lane = env.config, env.config["initial_lane_id"]
    return np.array([
        *(config.get(name, 0) for name in REWARDS),
        config["normalize_reward"], *config["reward_speed_range"], config["offroad_terminal"],
        config["duration"], -1 if lane is None else lane, config["ego_spacing"],
        1 / config["vehicles_density"], np.exp(-5 / 40 * config["lanes_count"]),
        *ranges.ravel(),
    ], float)  # fmt: skip


@outlined
def reset(s, ego, head, g, c):
    """``HighwayEnv._create_vehicles``."""
    ranges = c[RANGES:].reshape(6, 2)
    lane = np.int64(c[LANE])
    appear_at_random(s, ego, g, 0, lane, 25.0, c[SPACING], c[DENSITY])
    for i in range(1, s.n):
        appear_at_random(s, i, g, 0, -1, np.nan, c[OTHERS], c[DENSITY])
        randomize(s, i, g, ranges)


@outlined
def judge(s, ego, head, c, parts):
    """``HighwayEnv._reward``, ``_is_terminated``, ``_is_truncated``."""
    me = s.vehicles[ego]
    is_on_road = on_road(s, ego)
    speed = lmap(me.speed * cos(s.np, me.heading), c[SLOW], c[FAST], 0, 1)
    parts[COLLISION] = np.float64(me.crashed)
    parts[RIGHT_LANE] = lane_number(s, ego) / max(s.lanes[me.lane].count - 1, 1)
    parts[HIGH_SPEED] = clip(speed, 0.0, 1.0)
    parts[ON_ROAD] = 1.0 if is_on_road else 0.0
    reward = 0.0
    for index in range(len(parts)):
        reward += c[index] * parts[index]
    if c[NORMALIZE]:
        reward = lmap(reward, c[COLLISION], c[HIGH_SPEED] + c[RIGHT_LANE], 0, 1)
    reward *= parts[ON_ROAD]
    terminated = me.crashed or (c[OFFROAD_TERMINAL] and not is_on_road)
    return reward, terminated, head.time >= c[DURATION]


_settle = settling(reset, judge)


@cached
def settle(*arguments):
    """See ``settling``."""
    _settle(*arguments)
