"""Configurations of highway-env's environments that take other paths through its code.

Each names an event that must have happened in the stock episodes, so that it tests what it says.
"""

from __future__ import annotations

from functools import partial

import gymnasium as gym
import pytest

from tests.esc_gym.fastsim.lockstep import changing_lane, crashed, happened, lockstep


def action(type, **arguments):
    return {"action": {"type": type, **arguments}}


meta = partial(action, "DiscreteMetaAction")
grid = partial(action, "DiscreteAction")
continuous = partial(action, "ContinuousAction")


def agents(count, of, observation=None):
    """Several controlled vehicles."""
    observation = observation or {"type": "Kinematics"}
    return {
        "controlled_vehicles": count,
        "action": {"type": "MultiAgentAction", "action_config": of["action"]},
        "observation": {"type": "MultiAgentObservation", "observation_config": observation},
    }


def is_a(name):
    return lambda thing: thing["class"] == name


def has(**attributes):
    return lambda thing: attributes.items() <= thing.items()


def on_road(*ends):
    return lambda thing: thing["lane_index"][:2] == ends


a_vehicle, an_mdp_vehicle, a_bicycle = is_a("Vehicle"), is_a("MDPVehicle"), is_a("BicycleVehicle")
traffic, yielding = is_a("IDMVehicle"), has(is_yielding=True)

POSE = ["x", "y", "vx", "vy", "cos_h", "sin_h"]
GOAL = {"type": "KinematicsGoal", "features": POSE, "scales": [100, 100, 5, 5, 1, 1]}
SHUFFLED = {"type": "Kinematics", "order": "shuffled", "vehicles_count": 10, "see_behind": True}
DENSE = {"vehicles_density": 2, "lanes_count": 5, "vehicles_count": 30}
CROWDED = {"initial_vehicle_count": 20, "spawn_probability": 1}
CONNECTED = {"neighbour_vehicles_connected_lanes": True}
SHORT = {"before_merge_length": 60, "converge_merge_length": 40, "parallel_merge_length": 30}
SMALL = {"roundabout_radius": 12, "roundabout_lanes": 3}
ROADBLOCKS = {"block_lane": True, "force_decision": True}
BOTH_LIMITS = {"acceleration_range": [-20, 20], "steering_range": [-2, 2]}


def hz(simulation, policy):
    return {"simulation_frequency": simulation, "policy_frequency": policy}


# steps, id, configuration, event
CONFIGURATIONS = {
    "dense": (10, "highway-fast-v0", DENSE, changing_lane),
    "no traffic": (15, "highway-fast-v0", {"vehicles_count": 0}, an_mdp_vehicle),
    "one lane": (12, "highway-fast-v0", {"lanes_count": 1, "vehicles_density": 1.5}, crashed),
    "shuffled": (10, "highway-fast-v0", {"observation": SHUFFLED}, changing_lane),
    "connected highway": (8, "highway-fast-v0", CONNECTED, changing_lane),
    "crowded merge": (
        14,
        "merge-generic-v0",
        {"vehicles_count": 14, "lanes_count": 4},
        changing_lane,
    ),
    "short merge": (14, "merge-generic-v1", {"vehicles_count": 6} | SHORT, on_road("c", "d")),
    "crowded roundabout": (12, "roundabout-generic-v0", {"vehicles_count": 10}, changing_lane),
    "small roundabout": (10, "roundabout-generic-v1", {"vehicles_count": 8} | SMALL, changing_lane),
    "simple roundabout": (
        12,
        "roundabout-generic-v0",
        {"roundabout_lanes": 1},
        on_road("we", "sx"),
    ),
    "crowded intersection": (8, "intersection-v0", CROWDED, yielding),
    "any destination": (13, "intersection-v0", {"destination": None}, yielding),
    "narrow exit": (10, "exit-v0", {"lanes_count": 3, "vehicles_density": 3}, crashed),
    "five on a track": (25, "racetrack-v0", {"other_vehicles": 5}, traffic),
    "five on an oval": (25, "racetrack-oval-v1", {"other_vehicles": 5}, traffic),
    "roadblocks": (60, "racetrack-oval-v0", ROADBLOCKS, crashed),
    "parked vehicles": (40, "parking-v0", {"vehicles_count": 20}, crashed),
    "no walls": (30, "parking-v0", {"add_walls": False, "vehicles_count": 3}, is_a("Landmark")),
    # Frequencies
    "highway 5, 5 Hz": (40, "highway-fast-v0", hz(5, 5), changing_lane),
    "highway 10, 1 Hz": (8, "highway-fast-v0", hz(10, 1), changing_lane),
    "merge 30, 1 Hz": (15, "merge-v0", hz(30, 1), crashed),
    "merge 13, 5 Hz": (60, "merge-v0", hz(13, 5), crashed),
    "intersection 30, 5 Hz": (16, "intersection-v2", CROWDED | hz(30, 5), yielding),
    # Action types
    "target speeds": (15, "highway-fast-v0", meta(target_speeds=[0, 12, 24]), has(target_speed=12)),
    "lanes only": (12, "highway-fast-v0", meta(longitudinal=False), crashed),
    "speeds only": (16, "merge-v0", meta(lateral=False), crashed),
    "two speeds": (6, "intersection-v0", meta(lateral=False, target_speeds=[0, 15]), yielding),
    "meta, parking": (30, "parking-v0", meta() | {"vehicles_count": 8}, crashed),
    "grid": (12, "highway-fast-v0", grid(), a_vehicle),
    "grid of four": (10, "roundabout-v1", grid(actions_per_axis=2), a_vehicle),
    "grid, dynamical": (20, "parking-v0", grid(dynamical=True), a_bicycle),
    "dynamical": (15, "highway-fast-v0", continuous(dynamical=True), a_bicycle),
    "dynamical, steering": (
        25,
        "racetrack-v0",
        continuous(dynamical=True, longitudinal=False),
        a_bicycle,
    ),
    "dynamical, crossing": (6, "intersection-v0", continuous(dynamical=True), yielding),
    "throttle": (12, "highway-fast-v0", continuous(lateral=False), a_vehicle),
    "steering": (12, "highway-fast-v0", continuous(longitudinal=False), a_vehicle),
    "wide ranges": (15, "highway-fast-v0", continuous(**BOTH_LIMITS), lambda t: t["speed"] > 35),
    "speed range": (12, "highway-fast-v0", continuous(speed_range=[5, 22]), has(MAX_SPEED=22)),
    "reverse": (12, "highway-fast-v0", continuous(speed_range=[-9, 0]), lambda t: t["speed"] < 0),
    "two agents": (12, "highway-fast-v0", agents(2, meta()), crashed),
    "three agents": (12, "highway-fast-v0", agents(3, continuous()), changing_lane),
    "two agents, exit": (15, "exit-v0", agents(2, meta()), crashed),
    "two agents, parking": (30, "parking-v0", agents(2, continuous(), GOAL), is_a("Landmark")),
    "two agents, track": (20, "racetrack-v0", agents(2, continuous()), traffic),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_configuration(name):
    steps, env_id, config, event = CONFIGURATIONS[name]
    recording = lockstep(partial(gym.make, env_id, config=config), steps=steps)
    assert happened(recording, event)


@pytest.mark.slow
@pytest.mark.parametrize("driver", ["LinearVehicle", "AggressiveVehicle", "DefensiveVehicle"])
@pytest.mark.parametrize(
    ("env_id", "steps"),
    [
        ("highway-fast-v0", 8),
        ("exit-v0", 4),
        ("merge-v1", 12),
        ("roundabout-v0", 8),
        ("intersection-v0", 5),
    ],
)
def test_linear_drivers(env_id, steps, driver):
    config = {"other_vehicles_type": f"highway_env.vehicle.behavior.{driver}"}
    recording = lockstep(partial(gym.make, env_id, config=config), steps=steps)
    assert happened(recording, lambda thing: thing["class"] == driver and thing["data"])


@pytest.mark.parametrize(
    "observation", ["OccupancyGrid", "TimeToCollision", "LidarObservation", "ExitObservation"]
)
def test_observations(observation):
    """They read the road that the kernel writes."""
    env_id = "exit-v0" if observation == "ExitObservation" else "merge-v0"
    lockstep(partial(gym.make, env_id, config={"observation": {"type": observation}}), steps=8)


def test_an_intersection_that_is_empty_at_first():
    """Its reset simulates three seconds of a road without vehicles."""
    config = {"initial_vehicle_count": 1, "spawn_probability": 0.0}
    lockstep(partial(gym.make, "intersection-v0", config=config), steps=5)
