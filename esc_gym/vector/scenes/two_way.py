"""two-way-v0 (``envs/two_way_env.py``)."""

from __future__ import annotations

from typing import Any

import numpy as np
from highway_env.envs.two_way_env import TwoWayEnv

from esc_gym.fastsim.geometry import heading_at, position
from esc_gym.fastsim.known import Repeated
from esc_gym.fastsim.numerics import outlined
from esc_gym.vector.generators import normal
from esc_gym.vector.kernel import beginning, judging
from esc_gym.vector.scenes.roads import create, speed_number, weighted, weights

CLASSES = (TwoWayEnv,)
META_ONLY = True
REWARDS = {"high_speed_reward": float, "left_lane_reward": float}
HIGH_SPEED, LEFT_LANE = range(2)
REPEATED = Repeated(
    "b2a31a962c428b2810f4b8503bd66a5d8d21aa4734321a37dba30a10c24a8c86",
    (TwoWayEnv, "_reset _make_road _make_vehicles _reward _rewards _is_terminated _is_truncated"),
)
# Entries of the constants after ``weights``; the rest are the target speeds.
RIGHT, ONCOMING, SPEEDS = range(3, 6)


def unknown(env: Any) -> str:
    """Why the engine cannot do this configuration; "" if it can."""
    return ""


def constants(env: Any, network: Any) -> list[float]:
    """The configuration as numbers."""
    return [
        *weights(env.config, REWARDS),
        network.numbers["a", "b", 1], network.numbers["b", "a", 0],
        *env.action_type.target_speeds,
    ]  # fmt: skip


@outlined
def reset(s, ego, g, c, ranges, plans, lengths, template):
    """``TwoWayEnv._make_vehicles``; how many vehicles there are."""
    right, oncoming = np.int64(c[RIGHT]), np.int64(c[ONCOMING])
    x, y = position(s, right, 30.0)
    create(s, ego, x, y, 0.0, 30.0)
    for i in range(3):
        x, y = position(s, right, 70.0 + 40.0 * i + 10.0 * normal(g))
        heading = heading_at(s, right, 70.0 + 40.0 * i)
        create(s, 1 + i, x, y, heading, 24.0 + 2.0 * normal(g))
    for i in range(2):
        x, y = position(s, oncoming, 200.0 + 100.0 * i + 10.0 * normal(g))
        heading = heading_at(s, oncoming, 200.0 + 100.0 * i)
        create(s, 4 + i, x, y, heading, 20.0 + 5.0 * normal(g))
        s.vehicles[4 + i].target_lane = oncoming
    return s.n


@outlined
def judge(s, ego, head, action, c, parts):
    """``TwoWayEnv._reward``, ``_is_terminated``, ``_is_truncated``."""
    me, speeds = s.vehicles[ego], c[SPEEDS:]
    lanes = s.lanes[me.lane].count
    parts[HIGH_SPEED] = speed_number(s, ego, speeds) / (len(speeds) - 1)
    # One lane leads back: highway-env divides by zero there.
    others = np.float64(lanes - 1)
    parts[LEFT_LANE] = (lanes - 1 - s.lanes[me.target_lane].id) / others
    return weighted(parts, c, 2), me.crashed != 0, False


judge_all, begin_all = judging(judge), beginning(reset, judge)
