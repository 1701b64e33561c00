"""Every feature against an independent reading of the simulator."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401
import numpy as np
import pytest

from esc_gym.features import EGO_FEATURES
from tests.esc_gym.road import observe


@pytest.mark.parametrize("name", sorted(EGO_FEATURES))
def test_every_ego_feature_is_served_by_some_environment(name):
    base_id = {"goal": "parking-v0", "exit": "exit-v0", "ref": "lane-keeping-v0"}.get(
        name.split("_")[0], "intersection-v0"
    )
    env = gym.make(f"esc_gym/{base_id}", ego_features=[name])
    observation, _ = env.reset(seed=1)
    assert observation["ego"].shape == (1,)
    assert abs(observation["ego"][0]) <= 1


def test_ego_features_against_the_simulator():
    env = gym.make("esc_gym/intersection-v0", frame="ego")
    env.reset(seed=3)
    env.step(2)
    ego, road = env.unwrapped.vehicle, env.unwrapped.road
    values = dict(
        zip(
            env.get_wrapper_attr("set_spec").ego_features,
            env.get_wrapper_attr("decode")(observe(env))["ego"],
            strict=True,
        )
    )
    _, lateral, angle = ego.lane_offset
    to_destination = ego.destination - ego.position
    along = np.array([math.cos(ego.heading), math.sin(ego.heading)])
    expected = {
        "speed": ego.speed,
        "lat_off": lateral,
        "cos_lane": math.cos(angle),
        "sin_lane": math.sin(angle),
        "lanes_left": ego.lane_index[2],
        "lanes_right": len(road.network.all_side_lanes(ego.lane_index)) - 1 - ego.lane_index[2],
        "speed_limit": ego.lane.speed_limit,
        "target_speed": ego.target_speed,
        "dest_x": along @ to_destination,
        "dest_y": along[0] * to_destination[1] - along[1] * to_destination[0],
    }
    for name, value in expected.items():
        assert values[name] == pytest.approx(value, abs=1e-4), name


def test_extra_vehicle_features():
    features = ["obstacle", "width", "y", "cos_d", "sin_d", "length"]
    env = gym.make("esc_gym/intersection-v0", features=features, frame="world")
    observation, info = env.reset(seed=0)
    rows = env.get_wrapper_attr("decode")(observation)["vehicles"][: info["set"]["count"]]
    others = [v for v in env.unwrapped.road.vehicles if v is not env.unwrapped.vehicle]
    for row, other in zip(rows, others, strict=True):
        direction = other.destination_direction
        offset = other.position[1] - env.unwrapped.vehicle.position[1]
        assert row == pytest.approx([0, 2, offset, *direction, 5], abs=1e-4)
    assert observation in env.observation_space


def seen_from_an_ego(*others: tuple[float, float, float]) -> list[dict[str, float]]:
    """Features of vehicles at (x, y) with a speed, seen by an ego that drives along x at 20 m/s."""
    names = ["near_x", "near_y", "ahead", "behind", "left", "right"]
    names += ["urgency", "urgency_left", "urgency_right"]
    env = gym.make("esc_gym/highway-v0", config={"vehicles_count": len(others)}, features=names)
    env.reset(seed=0)
    base: Any = env.unwrapped
    ego, *rest = base.road.vehicles
    ego.heading, ego.speed = 0.0, 20.0
    for vehicle, (x, y, speed) in zip(rest, others, strict=True):
        vehicle.position, vehicle.heading, vehicle.speed = (
            ego.position + np.array([x, y]),
            0.0,
            speed,
        )
    rows = env.get_wrapper_attr("decode")(base.observation_type.observe())["vehicles"]
    return [dict(zip(names, row, strict=True)) for row in rows[: len(others)].tolist()]


def test_closeness():
    ahead, behind, beside, far, here = seen_from_an_ego(
        (20, 0, 10), (-40, 0, 20), (0, 4, 20), (80, -8, 20), (0, 0, 20)
    )
    approx = pytest.approx
    assert ahead["near_x"] == approx(0.5)
    assert ahead["near_y"] == approx(1.0)
    assert (ahead["ahead"], ahead["behind"]) == approx((0.5, 0.0))
    assert ahead["left"] == ahead["right"] == approx(0.5 / 17)
    assert ahead["urgency"] == approx(1 / (1 + 15 / 10))  # 20 m less a length, at 10 m/s
    assert (behind["ahead"], behind["behind"], behind["urgency"]) == approx((0.0, 0.2, 0.0))
    assert (beside["right"], beside["near_y"]) == approx((1.0, 1 / 17))
    assert beside["left"] == approx(1 / (1 + 4**4))
    assert (beside["urgency"], beside["urgency_left"]) == (0.0, 0.0)
    assert beside["urgency_right"] == approx(1.0)  # in the place where the ego would be
    assert ahead["urgency_left"] == ahead["urgency_right"] == 0.0
    (slower,) = seen_from_an_ego((20, -4, 10))  # as ahead, a lane to the left
    assert slower["urgency_left"] == approx(1 / (1 + 15 / 10))
    assert (slower["urgency"], slower["urgency_right"]) == (0.0, 0.0)
    assert max(far[name] for name in ("near_x", "ahead", "left", "right")) < 0.1
    assert [here[name] for name in ("near_x", "near_y", "ahead", "behind", "urgency")] == [1] * 5
