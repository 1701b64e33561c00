"""Traffic of our environments does not depend on what the process made before."""

from __future__ import annotations

import json
import subprocess
import sys

import gymnasium as gym
import highway_env  # noqa: F401
import pytest
from highway_env.vehicle import behavior
from highway_env.vehicle.behavior import AggressiveVehicle, IDMVehicle

from esc_gym.fastsim.behavior import PARAMETERS, original_behavior


def positions(env, seed=7, steps=6):
    env.reset(seed=seed)
    for _ in range(steps):
        env.step(1)
    return [
        [type(v).__name__, *v.position.tolist(), v.speed, v.heading]
        for v in env.unwrapped.road.vehicles
    ]


FRESH = """
import json, logging, sys, warnings
warnings.simplefilter("ignore")
import gymnasium as gym, highway_env
env = gym.make(sys.argv[1], config=json.loads(sys.argv[2]))
env.reset(seed=7)
for _ in range(6):
    env.step(1)
print(json.dumps([[type(v).__name__, *v.position.tolist(), v.speed, v.heading]
                  for v in env.unwrapped.road.vehicles]))
"""


def in_a_fresh_stock_process(env_id, config):
    arguments = [sys.executable, "-c", FRESH, env_id, json.dumps(config)]
    return json.loads(subprocess.run(arguments, check=True, capture_output=True).stdout)


@pytest.fixture(autouse=True)
def clean_classes():
    """Leave the process as it was: these tests contaminate it on purpose."""
    with original_behavior(AggressiveVehicle):
        yield


AGGRESSIVE = {"other_vehicles_type": "highway_env.vehicle.behavior.AggressiveVehicle"}


@pytest.mark.parametrize(
    ("env_id", "config"),
    [
        ("highway-fast-v0", {}),
        ("highway-fast-v0", AGGRESSIVE),
        ("intersection-v0", {}),
        ("intersection-v0", AGGRESSIVE),
        ("roundabout-v0", {}),
        ("exit-v0", {}),
    ],
)
def test_same_episode_whatever_was_made_before(env_id, config):
    expected = in_a_fresh_stock_process(env_id, config)
    env = gym.make(f"esc_gym/{env_id}", config=config)
    assert positions(env) == expected
    gym.make("intersection-v0")  # stock: contaminates the class for the process
    gym.make("intersection-v0", config=AGGRESSIVE)
    assert IDMVehicle.DISTANCE_WANTED == 7
    assert positions(env) == expected
    assert positions(gym.make(f"esc_gym/{env_id}", config=config)) == expected


def test_contamination_in_mid_episode():
    env = gym.make("esc_gym/highway-fast-v0")
    expected = positions(env)
    env.reset(seed=7)
    for step in range(6):
        env.step(1)
        if step == 2:
            gym.make("intersection-v0")
    assert [v.position.tolist() for v in env.unwrapped.road.vehicles] == [p[1:3] for p in expected]


def test_our_intersections_leave_the_process_alone():
    env = gym.make("esc_gym/intersection-v0")
    env.reset(seed=0)
    for _ in range(5):
        simulated = list(env.unwrapped.road.vehicles)
        env.step(1)
    assert [getattr(IDMVehicle, name) for name in PARAMETERS] == [10.0, 3.0, -5.0]
    traffic = [v for v in simulated if isinstance(v, IDMVehicle)]
    assert traffic
    for vehicle in traffic:
        assert [getattr(vehicle, name) for name in PARAMETERS] == [7, 6, -3]


def test_original_behavior_restores_what_it_found():
    IDMVehicle.DISTANCE_WANTED = 1.0
    AggressiveVehicle.COMFORT_ACC_MAX = 2.0
    with original_behavior(AggressiveVehicle):
        assert IDMVehicle.DISTANCE_WANTED == 10.0
        assert AggressiveVehicle.COMFORT_ACC_MAX == 3.0
        assert "COMFORT_ACC_MAX" not in vars(AggressiveVehicle)
    assert IDMVehicle.DISTANCE_WANTED == 1.0
    assert vars(AggressiveVehicle)["COMFORT_ACC_MAX"] == 2.0


def test_a_users_vehicle_class_keeps_its_own_parameters(monkeypatch):
    class Timid(IDMVehicle):
        DISTANCE_WANTED = 30.0

    monkeypatch.setattr(behavior, "Timid", Timid, raising=False)
    Timid.__module__ = "users_module"
    config = {"other_vehicles_type": "highway_env.vehicle.behavior.Timid"}
    env = gym.make("esc_gym/highway-fast-v0", config=config)
    env.reset(seed=0)
    assert env.unwrapped.road.vehicles[-1].DISTANCE_WANTED == 30.0
