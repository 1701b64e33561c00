"""exit-v0 and exit-v1 (``envs/exit_env.py``)."""

from __future__ import annotations

from typing import Any

import numpy as np
from highway_env.envs.exit_env import ConnectedLaneExitEnv, ExitEnv

from esc_gym.fastsim.known import Repeated
from esc_gym.fastsim.numerics import clip, outlined
from esc_gym.vector.generators import random
from esc_gym.vector.kernel import beginning, judging
from esc_gym.vector.scenes.roads import create_random, lmap, plan, wanted_lane, weighted, weights

CLASSES = (ExitEnv, ConnectedLaneExitEnv)
REWARDS = {
    "collision_reward": bool, "goal_reward": bool, "high_speed_reward": float,
    "right_lane_reward": int,
}  # fmt: skip
COLLISION, GOAL, HIGH_SPEED, RIGHT_LANE = range(4)
SUCCESS = "goal_reward"  # what ``info["is_success"]`` says, too
DESTINATIONS = ("3",)
REPEATED = Repeated(
    "874446a451858dd619bb376dc403f0972c5ea27d0d0ae6a38e7ba2306ffd09ee",
    (ExitEnv, "_reset step _create_road _create_vehicles _reward _rewards _is_success"),
    (ExitEnv, "_is_terminated _is_truncated"),
)
# Entries of the constants after ``weights``; the rest are the lanes' chances.
NORMALIZE, SLOW, FAST, DURATION, SPACING, OTHERS, DENSITY, EXIT, RAMP, CHANCES = range(5, 15)


def unknown(env: Any) -> str:
    """Why the engine cannot do this configuration; "" if it can."""
    config = env.config
    low, high = config["reward_speed_range"]
    if low == high or (
        config["normalize_reward"] and config["goal_reward"] == config["collision_reward"]
    ):
        return "a reward whose range is empty"
    return "one lane" if config["lanes_count"] < 2 else ""


def lane(env: Any, network: Any) -> int:
    """The lane of the ego features ``exit_x`` and ``exit_y``."""
    return network.numbers["1", "2", env.config["lanes_count"]]


def constants(env: Any, network: Any) -> list[float]:
    """The configuration as numbers."""
    config, lanes = env.config, np.arange(env.config["lanes_count"])
    chances = (lanes / lanes.sum()).cumsum()
    return [
        *weights(config, REWARDS),
        config["normalize_reward"], *config["reward_speed_range"], config["duration"],
        config["ego_spacing"], 1 / config["vehicles_density"], np.exp(-5 / 40 * len(lanes)),
        lane(env, network), network.numbers["2", "exit", 0], *(chances / chances[-1]),
    ]  # fmt: skip


@outlined
def reset(s, ego, g, c, ranges, plans, lengths, template):
    """``ExitEnv._create_vehicles``; how many vehicles there are."""
    create_random(s, ego, g, 0, 25.0, c[SPACING], c[DENSITY])
    for i in range(1, s.n):
        k = np.searchsorted(c[CHANCES:], random(g), side="right")
        create_random(s, i, g, k, s.lanes[k].speed_limit, c[OTHERS], c[DENSITY])
        plan(s, i, 0, plans, lengths)
    return s.n


@outlined
def judge(s, ego, head, action, c, parts):
    """``ExitEnv._reward``, ``_is_terminated``, ``_is_truncated``."""
    me = s.vehicles[ego]
    k = wanted_lane(s, ego)
    parts[COLLISION] = np.float64(me.crashed)
    parts[GOAL] = 1.0 if k in (c[EXIT], c[RAMP]) else 0.0
    parts[HIGH_SPEED] = clip(lmap(me.speed, c[SLOW], c[FAST], 0, 1), 0.0, 1.0)
    parts[RIGHT_LANE] = s.lanes[k].id
    reward = weighted(parts, c, 2)
    if c[NORMALIZE]:
        reward = clip(lmap(reward, c[COLLISION], c[GOAL], 0, 1), 0.0, 1.0)
    return reward, me.crashed != 0, head.time >= c[DURATION]


judge_all, begin_all = judging(judge), beginning(reset, judge)
