"""From arrays back to highway-env's own objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from highway_env import utils
from highway_env.vehicle.controller import MDPVehicle

from esc_gym.fastsim.kernel import EGO, ITEMS, ROAD_STEPS, VEHICLES
from esc_gym.fastsim.network import Network
from esc_gym.fastsim.records import (
    BICYCLE,
    CONTROLLED,
    CRASH,
    HIT,
    IDM,
    IMPACT,
    LANDMARK,
    LANE_CHANGED,
    LINEAR,
    NO_LANE,
    OBSTACLE,
    SAMPLE_COLUMNS,
    TARGET_CHANGED,
    YIELD,
)
from esc_gym.fastsim.traffic import Traffic
from esc_gym.measures import speed_along_lane, time_to_collision
from esc_gym.vector.generators import generator
from esc_gym.vector.measures import Measured
from esc_gym.vector.state import ROAD, SHUFFLE, State


def reset_quietly(env: Any) -> None:
    """Reset an environment whose observation nobody looks at: vehicles may be too many for it."""
    kind = env.unwrapped.observation_type
    kind._overflow = lambda count: None
    try:
        env.reset(seed=0)
    finally:
        del kind._overflow


def materialise(env: Any, state: State, e: int) -> None:
    """Bring ``env``, just reset and with the vehicles of environment ``e``, into its state."""
    base, head = env.unwrapped, state.heads[e]
    base.np_random = base.road.np_random = generator(state.generators[e, ROAD])
    base.observation_type.rng = generator(state.generators[e, SHUFFLE])
    base.time, base.steps = float(head["time"]), int(head["steps"])
    _make_room(base, int(state.counts[e, VEHICLES]), int(state.counts[e, EGO]))
    traffic, network = Traffic(), Network(base.road.network)
    traffic.gather(base.road, network, False)
    records = state.vehicles[e, : state.counts[e, ITEMS] + 1].copy()
    records["route_taken"] = 0
    kinds = records["kind"]
    records["changed"] = CRASH | HIT | (records["changed"] & YIELD)
    records["changed"] |= LANE_CHANGED
    records["changed"][kinds < OBSTACLE] |= IMPACT
    records["changed"][(kinds >= CONTROLLED) & (kinds < OBSTACLE)] |= TARGET_CHANGED
    traffic.records = records
    traffic.scatter(np.empty((0, SAMPLE_COLUMNS)))
    for i, item in enumerate(traffic.items):
        _restore(item, state.vehicles[e, i], int(state.ids[e, i]))
        if CONTROLLED <= state.vehicles[e, i]["kind"] < OBSTACLE:
            _restore_route(item, state.vehicles[e, i], state.routes[e, i], network)
    if isinstance(ego := base.vehicle, MDPVehicle):
        # Its target speed is always one of its target speeds.
        ego.speed_index = ego.target_speeds.tolist().index(ego.target_speed)
    if hasattr(base, "lanes"):  # those of lane-keeping, which it has still to follow
        lanes = [network.lanes[network.numbers[index]] for index in (("c", "d", 0), ("a", "b", 0))]
        base.lane = network.lanes[head["lane"]]
        base.lanes = lanes[lanes.index(base.lane) + 1 :]
    if hasattr(base.road, "steps"):
        base.road.steps = int(state.counts[e, ROAD_STEPS])
    base.road.set_ids = int(head["next_id"]) - 1


def follow_road(base: Any, state: State, e: int, vehicle: int) -> None:
    """Let a vehicle of environment ``e``, in mid-step, change to the lane after its own.

    By highway-env's own code, for routes that lead elsewhere. base: any environment of this road.
    """
    materialise(base, state, e)
    record = state.vehicles[e, vehicle]
    record["route_taken"] = 0
    traffic = Traffic()
    traffic.gather(base.road, Network(base.road.network), False)
    traffic.records = state.vehicles[e]
    traffic.follow_road(vehicle)
    length = record["route_length"]
    state.routes[e, vehicle, :length] = traffic.routes[vehicle, :length]


def _make_room(base: Any, n: int, ego: int) -> None:
    """Have ``n`` vehicles on the road, whatever their state, and the ego in its place."""
    others = [vehicle for vehicle in base.road.vehicles if vehicle is not base.vehicle][: n - 1]
    driver = utils.class_from_path(base.config["other_vehicles_type"])
    while len(others) < n - 1:
        others.append(driver(base.road, [0.0, 0.0]))
    base.road.vehicles = [*others[:ego], base.vehicle, *others[ego:]]


def _restore_route(item: Any, record: Any, steps: np.ndarray, network: Network) -> None:
    taken, length = int(record["route_taken"]), int(record["route_length"])
    if taken or length or item.route:
        item.route = [
            (*network.indexes[road][:2], None if lane == NO_LANE else int(lane))
            for road, lane in steps[taken : taken + length].tolist()
        ]


def _restore(item: Any, record: Any, number: int) -> None:
    """What a step does not change, or not without saying so."""
    d, kind = vars(item), record["kind"]
    limits = record["min_speed"], record["max_speed"]
    if kind < OBSTACLE and limits != (item.MIN_SPEED, item.MAX_SPEED):
        d["MIN_SPEED"], d["MAX_SPEED"] = limits
    if CONTROLLED <= kind < OBSTACLE:
        d["target_speed"] = record["target_speed"]
    if kind in (IDM, LINEAR) and record["delta"] != item.DELTA:
        d["DELTA"] = float(record["delta"])
    if kind == LINEAR:
        for name, count, of in (("ACCELERATION", 3, "acceleration"), ("STEERING", 2, "steering")):
            values = np.array([record[f"{of}_{index}"] for index in range(count)])
            if (values != getattr(item, f"{name}_PARAMETERS")).any():
                d[f"{name}_PARAMETERS"] = values
    if kind == LANDMARK:
        item.position[:], item.heading = (record["x"], record["y"]), record["heading"]
    if "is_yielding" in d and not record["changed"] & YIELD:  # it is of its own reset
        if d.pop("is_yielding"):
            del d["color"]
        del d["yield_timer"]
    if kind == BICYCLE:
        d["lateral_speed"], d["yaw_rate"] = record["lateral_speed"], record["yaw_rate"]
    d.pop("set_id", None)
    if number >= 0:
        d["set_id"] = number


def measured(envs: Sequence[Any], roads: dict[Any, int], collisions: bool) -> Measured:
    """``Measured`` of environments one by one. roads: numbers of roads, which are added to."""
    found = Measured.empty(len(envs))
    for e, env in enumerate(envs):
        base = env.unwrapped
        ego = base.vehicle
        start, end, lane = ego.lane_index
        road = roads.setdefault((start, end), len(roads))
        values = ego.speed, ego.crashed, speed_along_lane(ego), ego.on_road, road, lane
        for column, value in zip(found, values, strict=False):
            column[e] = value
        if collisions:
            found.time[e] = time_to_collision(base)
    return found
