"""racetrack-v0, -v1, and the large and oval ones (``envs/racetrack_env.py``)."""

from __future__ import annotations

from typing import Any

import numpy as np
from highway_env.envs.common.action import ContinuousAction
from highway_env.envs.racetrack_env import (
    ConnectedLaneRacetrackEnv,
    ConnectedLaneRacetrackEnvLarge,
    ConnectedLaneRacetrackEnvOval,
    RacetrackEnv,
    RacetrackEnvLarge,
    RacetrackEnvOval,
)
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle

from esc_gym.fastsim.geometry import local_coordinates
from esc_gym.fastsim.known import Repeated
from esc_gym.fastsim.numerics import libm, outlined
from esc_gym.fastsim.records import STRAIGHT
from esc_gym.vector.generators import below, uniform
from esc_gym.vector.kernel import beginning, judging
from esc_gym.vector.scenes.roads import distance, lmap, make_on_lane, on_road, weighted, weights

CLASSES = (
    RacetrackEnv, ConnectedLaneRacetrackEnv, RacetrackEnvLarge, ConnectedLaneRacetrackEnvLarge,
    RacetrackEnvOval, ConnectedLaneRacetrackEnvOval,
)  # fmt: skip
REWARDS = {
    "lane_centering_reward": float, "action_reward": np.float32, "collision_reward": bool,
    "on_road_reward": bool,
}  # fmt: skip
CENTERING, ACTION, COLLISION, ON_ROAD = range(4)
REPEATED = Repeated(
    "b9a68e9a493c9d853930f8dc6b98a40d118ac7ead6ae1a0880bad63ecc079e0b",
    (RacetrackEnv, "_reset _make_road _make_vehicles _reward _rewards"),
    (RacetrackEnv, "_is_terminated _is_truncated"),
    (RacetrackEnvLarge, "_make_road"),
    (RacetrackEnvOval, "_make_road _make_vehicles"),
    (RoadNetwork, "random_lane_index"),
)
# Entries of the constants after ``weights``; then for each node, in order, how many
# roads begin there, and the first ROADS_FROM_ONE of them.
COST, OFF_ROAD_ENDS, DURATION, OTHERS, STARTS, START, FRONT, NODES, ROADS = range(5, 14)
ROADS_FROM_ONE = 4


def unknown(env: Any) -> str:
    """Why the engine cannot do this configuration; "" if it can."""
    config = env.config
    if type(env.action_type) is not ContinuousAction:
        return "actions that are not continuous"
    if config["collision_reward"] == 1:
        return "a reward whose range is empty"
    if config["other_vehicles_type"].rsplit(".", 1)[-1] != IDMVehicle.__name__:
        return "traffic that racetracks do not make"
    if isinstance(env, RacetrackEnvOval) and not (config["length"] and config["no_lanes"]):
        return "a racetrack that is drawn anew"
    graph = env.road.network.graph
    return "a road network" if max(map(len, graph.values())) > ROADS_FROM_ONE else ""


def capacity(env: Any) -> int:
    """The most vehicles that there can be."""
    return 1 + env.config["other_vehicles"]


def constants(env: Any, network: Any) -> list[float]:
    """The configuration as numbers."""
    config, graph = env.config, env.road.network.graph
    oval = isinstance(env, RacetrackEnvOval)
    nodes = []
    for start, ends in graph.items():
        roads = [network.numbers[start, end, 0] for end in ends]
        nodes += [len(roads), *roads, *[0] * (ROADS_FROM_ONE - len(roads))]
    return [
        *weights(config, REWARDS),
        config["lane_centering_cost"], config["terminate_off_road"], config["duration"],
        config["other_vehicles"], config["no_lanes"] if oval else 2, network.numbers["a", "b", 0],
        network.numbers["b", "c", 0], len(graph), *nodes,
    ]  # fmt: skip


@outlined
def anywhere(s, g, c):
    """``RoadNetwork.random_lane_index``."""
    node = ROADS + below(g, np.int64(c[NODES])) * (1 + ROADS_FROM_ONE)
    road = np.int64(c[node + 1 + below(g, np.int64(c[node]))])
    return road + below(g, s.lanes[road].count)


@outlined
def reset(s, ego, g, c, ranges, plans, lengths, template):
    """``_make_vehicles``; how many vehicles there are."""
    number = below(g, np.int64(c[STARTS]))
    start = np.int64(c[START]) + number
    along = uniform(g, 20.0, 50.0)
    make_on_lane(s, ego, start, along, s.lanes[start].speed_limit)
    if c[OTHERS] == 0:
        return 1
    front = np.int64(c[FRONT])
    along = uniform(g, 0.0, s.lanes[front].length)
    make_on_lane(s, 1, front + number, along, 6.0 + uniform(g, 0.0, 3.0))
    n = 2
    for _ in range(below(g, np.int64(c[OTHERS]))):
        k = anywhere(s, g, c)
        along = uniform(g, 0.0, s.lanes[k].length)
        make_on_lane(s, n, k, along, 6.0 + uniform(g, 0.0, 3.0))
        me, alone = s.vehicles[n], True
        for i in range(n):
            other = s.vehicles[i]
            alone = alone and not distance(s, me.x, me.y, other.x, other.y) < 20
        n += alone
    return n


@outlined
def judge(s, ego, head, action, c, parts):
    """``RacetrackEnv._reward``, ``_is_terminated``, ``_is_truncated``.

    The norm of an action is as precise as the action. So is the sum with it on a straight lane,
    whose coordinates are Python's numbers, until ``on_road`` is added, a truth value of NumPy's.
    """
    me = s.vehicles[ego]
    is_on_road = on_road(s, ego)
    lateral = local_coordinates(s, me.lane, me.x, me.y)[1]
    parts[CENTERING] = 1 / (1 + c[COST] * libm(s.np.libm_pow, lateral, 2.0))
    parts[ACTION] = max(action, 0.0)
    parts[COLLISION] = me.crashed
    parts[ON_ROAD] = 1.0 if is_on_road else 0.0
    if head.single:
        effort = np.float32(c[ACTION]) * np.float32(parts[ACTION])
        if s.lanes[me.lane].kind == STRAIGHT:
            single = np.float32(c[CENTERING] * parts[CENTERING]) + effort
            reward = np.float64(single + np.float32(c[COLLISION] * parts[COLLISION]))
        else:
            reward = c[CENTERING] * parts[CENTERING] + effort + c[COLLISION] * parts[COLLISION]
        reward += c[ON_ROAD] * parts[ON_ROAD]
    else:
        reward = weighted(parts, c, 1)
    reward = lmap(reward, c[COLLISION], 1.0, 0, 1) * parts[ON_ROAD]
    terminated = me.crashed or (c[OFF_ROAD_ENDS] and not is_on_road)
    return reward, terminated, head.time >= c[DURATION]


judge_all, begin_all = judging(judge), beginning(reset, judge)
