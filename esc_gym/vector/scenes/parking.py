"""parking-v0, -parked-v0 and -ActionRepeat-v0 (``envs/parking_env.py``)."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from highway_env.envs.common.observation import KinematicsGoalObservation
from highway_env.envs.parking_env import ParkingEnv
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, RoadObject

from esc_gym.fastsim.cache import cached
from esc_gym.fastsim.engine import machine
from esc_gym.fastsim.geometry import position
from esc_gym.fastsim.known import Repeated
from esc_gym.fastsim.numerics import FUSED_SECOND, compiled, fused, outlined, power
from esc_gym.parking import SET_PARKING
from esc_gym.vector.columns import goal_entry
from esc_gym.vector.generators import below, uniform
from esc_gym.vector.kernel import beginning, judging
from esc_gym.vector.scenes.roads import create, make_on_lane, place

CLASSES = tuple(SET_PARKING.values())
REWARDS: dict[str, type] = {}
EXTRAS = {"is_success": np.bool_}
SUCCEEDED = 0
FEATURES = ["x", "y", "vx", "vy", "cos_h", "sin_h"]
REPEATED = Repeated(
    "167bfdc66a20d0c6ddbb43ba2bc363d5f3486e8a28a4fdcfa9c121bb27700b77",
    (ParkingEnv, "_reset _create_road _create_vehicles _info compute_reward _is_terminated"),
    (ParkingEnv, "_is_truncated define_spaces"),
    (KinematicsGoalObservation, "__init__"),
    (Landmark, "__init__"),
    (RoadObject, "to_dict"),
    (Vehicle, "to_dict"),
)
# The constants: weights and scales of the features, then these.
WEIGHTS, SCALES, GOAL, COLLISION, DURATION = 0, 6, 12, 13, 14


def unknown(env: Any) -> str:
    """Why the engine cannot do this configuration; "" if it can."""
    if hasattr(env.action_type, "actions"):
        return "meta-actions where there are no lanes to change"
    goal, weights = env.PARKING_OBS["observation"], env.config["reward_weights"]
    if goal["features"] != FEATURES or not len(goal["scales"]) == len(weights) == 6:
        return "a reward of other features"
    return "" if multiplies_alike() else "this machine's NumPy rounds dot products of six otherwise"


def constants(env: Any, network: Any) -> list[float]:
    """The configuration as numbers."""
    config = env.config
    return [
        *config["reward_weights"], *env.PARKING_OBS["observation"]["scales"],
        config["success_goal_reward"], config["collision_reward"], config["duration"],
    ]  # fmt: skip


@compiled
def add_product(rounding, total, a, b):
    """total + a * b, as BLAS rounds it."""
    return fused(a, b, total) if rounding == FUSED_SECOND else total + a * b


@outlined
def reset(s, ego, g, c, ranges, plans, lengths, template):
    """``ParkingEnv._create_vehicles``; how many vehicles there are."""
    create(s, ego, 0.0, 0.0, 2.0 * np.pi * uniform(g, 0.0, 1.0), 0.0)
    spots, left = np.arange(len(s.lanes)), len(s.lanes)
    left = without(spots, left, s.vehicles[ego].lane)
    k = spots[below(g, left)]
    x, y = position(s, k, s.lanes[k].length / 2)
    place(s, s.n, x, y, s.lanes[k].heading, 0.0)
    left = without(spots, left, k)
    for i in range(1, s.n):
        k = spots[below(g, left)]
        make_on_lane(s, i, k, 4.0, 0.0)
        left = without(spots, left, k)
    return s.n


@outlined
def without(spots, count, lane):
    """Remove a lane from the first ``count`` of ``spots``; how many are left."""
    kept = 0
    for index in range(count):
        if spots[index] != lane:
            spots[kept] = spots[index]
            kept += 1
    return kept


@outlined
def proximity(s, ego, c):
    """``ParkingEnv.compute_reward`` of ``GoalObservation``."""
    total = 0.0
    for index in range(6):
        mine = goal_entry(s, ego, index) / c[SCALES + index]
        apart = abs(mine - goal_entry(s, s.n, index) / c[SCALES + index])
        total = add_product(s.np.dot, total, apart, c[WEIGHTS + index])
    return -power(s.np, total, 0.5)


@outlined
def judge(s, ego, head, action, c, parts):
    """``ParkingEnv._reward``, ``_is_terminated``, ``_is_truncated``."""
    near, crashed = proximity(s, ego, c), s.vehicles[ego].crashed
    parts[SUCCEEDED] = near > -c[GOAL]
    reward = near + (c[COLLISION] if crashed else 0.0)
    return reward, crashed or near > -c[GOAL], head.time >= c[DURATION]


judge_all, begin_all = judging(judge), beginning(reset, judge)


@cached
def dots(rounding, one, other, found):
    """Dot products of the rows of ``one`` and ``other`` [K, 6]."""
    for row in range(len(found)):
        total = 0.0
        for column in range(6):
            total = add_product(rounding, total, one[row, column], other[row, column])
        found[row] = total


@cache
def multiplies_alike() -> bool:
    """Whether ``dots`` are this machine's ``np.dot``, to the last bit."""
    one, other = np.abs(np.random.default_rng(0).normal(size=(2, 500, 6)))
    found = np.empty(500)
    dots(machine()[1][-3], one, other, found)
    return found.tolist() == [np.dot(a, b) for a, b in zip(one, other, strict=True)]
