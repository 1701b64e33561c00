"""From arrays back to highway-env's own objects."""

from __future__ import annotations

from typing import Any

import numpy as np
from highway_env.vehicle.controller import MDPVehicle

from esc_gym.fastsim.network import Network
from esc_gym.fastsim.records import (
    BICYCLE,
    CONTROLLED,
    CRASH,
    HIT,
    IDM,
    IMPACT,
    LANE_CHANGED,
    LINEAR,
    OBSTACLE,
    SAMPLE_COLUMNS,
    TARGET_CHANGED,
)
from esc_gym.fastsim.traffic import Traffic
from esc_gym.vector.generators import generator
from esc_gym.vector.state import ROAD, SHUFFLE, State


def materialise(env: Any, state: State, e: int) -> None:
    """Bring ``env``, just reset and with the vehicles of environment ``e``, into its state."""
    base, head = env.unwrapped, state.heads[e]
    base.np_random = base.road.np_random = generator(state.generators[e, ROAD])
    base.observation_type.rng = generator(state.generators[e, SHUFFLE])
    base.time, base.steps = float(head["time"]), int(head["steps"])
    traffic = Traffic()
    traffic.gather(base.road, Network(base.road.network), False)
    records = state.vehicles[e].copy()
    records["changed"] = LANE_CHANGED | CRASH | IMPACT | HIT
    records["changed"][records["kind"] >= CONTROLLED] |= TARGET_CHANGED
    traffic.records = records
    traffic.scatter(np.empty((0, SAMPLE_COLUMNS)))
    for item, record, number in zip(traffic.items, records[:-1], state.ids[e], strict=True):
        _restore(item, record, int(number))
    if isinstance(ego := base.vehicle, MDPVehicle):
        # Its target speed is always one of its target speeds.
        ego.speed_index = ego.target_speeds.tolist().index(ego.target_speed)
    base.road.set_ids = int(head["next_id"]) - 1


def _restore(item: Any, record: Any, number: int) -> None:
    """What a step does not change, or not without saying so."""
    d, kind = vars(item), record["kind"]
    limits = record["min_speed"], record["max_speed"]
    if kind < OBSTACLE and limits != (item.MIN_SPEED, item.MAX_SPEED):
        d["MIN_SPEED"], d["MAX_SPEED"] = limits
    if kind >= CONTROLLED:
        d["target_speed"] = record["target_speed"]
    if kind >= IDM:
        d["DELTA"] = float(record["delta"])
    if kind == LINEAR:
        names = "acceleration_0", "acceleration_1", "acceleration_2", "steering_0", "steering_1"
        values = np.array([record[name] for name in names])
        d["ACCELERATION_PARAMETERS"], d["STEERING_PARAMETERS"] = values[:3], values[3:]
    if kind == BICYCLE:
        d["lateral_speed"], d["yaw_rate"] = record["lateral_speed"], record["yaw_rate"]
    d.pop("set_id", None)
    if number >= 0:
        d["set_id"] = number
