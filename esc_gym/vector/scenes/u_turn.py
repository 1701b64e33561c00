"""u-turn-v0 and u-turn-v1 (``envs/u_turn_env.py``)."""

from __future__ import annotations

from typing import Any

from highway_env.envs.u_turn_env import ConnectedLaneUTurnEnv, UTurnEnv

from esc_gym.fastsim.geometry import position
from esc_gym.fastsim.known import Repeated
from esc_gym.fastsim.numerics import clip, outlined
from esc_gym.fastsim.records import CONTROLLED
from esc_gym.vector.generators import normal
from esc_gym.vector.kernel import beginning, judging
from esc_gym.vector.scenes.roads import (
    create,
    lmap,
    make_on_lane,
    on_road,
    plan,
    randomize,
    weighted,
    weights,
)

CLASSES = (UTurnEnv, ConnectedLaneUTurnEnv)
REWARDS = {
    "collision_reward": bool, "left_lane_reward": float, "high_speed_reward": float,
    "on_road_reward": bool,
}  # fmt: skip
COLLISION, LEFT_LANE, HIGH_SPEED, ON_ROAD = range(4)
DESTINATIONS = ("d",)
REPEATED = Repeated(
    "294915219178ba21b411fdfa913f8a2b1279d2cdbc6d8ab25afbfad0a13b5377",
    (UTurnEnv, "_reset _make_road _make_vehicles _reward _rewards _is_terminated _is_truncated"),
)
# Entries of the constants after ``weights``; then the lanes of the six others.
NORMALIZE, SLOW, FAST, DURATION, START, PLACES = range(5, 11)


def unknown(env: Any) -> str:
    """Why the engine cannot do this configuration; "" if it can."""
    config = env.config
    low, high = config["reward_speed_range"]
    best = config["high_speed_reward"] + config["left_lane_reward"]
    if low == high or (config["normalize_reward"] and best == config["collision_reward"]):
        return "a reward whose range is empty"
    return ""


def constants(env: Any, network: Any) -> list[float]:
    """The configuration as numbers."""
    config, number = env.config, network.numbers
    places = [
        (number["a", "b", 0], 25.0, 13.5), (number["a", "b", 1], 56.0, 14.5),
        (number["b", "c", 1], 0.5, 4.5), (number["b", "c", 0], 17.5, 5.5),
        (number["c", "d", 0], 1.0, 3.5), (number["c", "d", 1], 30.0, 5.5),
    ]  # fmt: skip
    return [
        *weights(config, REWARDS),
        config["normalize_reward"], *config["reward_speed_range"], config["duration"],
        number["a", "b", 0], *(value for place in places for value in place),
    ]  # fmt: skip


@outlined
def reset(s, ego, g, c, ranges, plans, lengths, template):
    """``UTurnEnv._make_vehicles``; how many vehicles there are."""
    x, y = position(s, int(c[START]), 0.0)
    create(s, ego, x, y, 0.0, 16.0)
    if s.vehicles[ego].kind >= CONTROLLED:
        plan(s, ego, 0, plans, lengths)
    for i in range(1, 7):
        lane, along, speed = c[PLACES + 3 * i - 3], c[PLACES + 3 * i - 2], c[PLACES + 3 * i - 1]
        along += normal(g) * 2.0
        make_on_lane(s, i, int(lane), along, speed + normal(g) * 2.0)
        plan(s, i, 0, plans, lengths)
        if i == 1:
            randomize(s, i, g, ranges)
    return s.n


@outlined
def judge(s, ego, head, action, c, parts):
    """``UTurnEnv._reward``, ``_is_terminated``, ``_is_truncated``."""
    me = s.vehicles[ego]
    lane = s.lanes[me.lane]
    parts[COLLISION] = me.crashed
    parts[LEFT_LANE] = lane.id / max(lane.count - 1, 1)
    parts[HIGH_SPEED] = clip(lmap(me.speed, c[SLOW], c[FAST], 0, 1), 0.0, 1.0)
    parts[ON_ROAD] = 1.0 if on_road(s, ego) else 0.0
    reward = weighted(parts, c, 2)
    if c[NORMALIZE]:
        reward = lmap(reward, c[COLLISION], c[HIGH_SPEED] + c[LEFT_LANE], 0, 1)
    return reward * parts[ON_ROAD], me.crashed != 0, head.time >= c[DURATION]


judge_all, begin_all = judging(judge), beginning(reset, judge)
