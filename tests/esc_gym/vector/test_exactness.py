"""Batches of all scenarios that the engine knows, against stock environments."""

from __future__ import annotations

import pytest

from tests.esc_gym.vector.stock import compare, resets


def some_slow(names, ordinary):
    """Parameters of which all but the ordinary ones are slow."""
    marks = {name: () if name in ordinary else pytest.mark.slow for name in names}
    return [pytest.param(name, marks=mark) for name, mark in marks.items()]


FEW = {"vehicles_count": 12, "duration": 6}


def test_highway_fast_over_resets():
    seeds = range(6)
    expected = compare("esc_gym/highway-fast-v0", seeds=seeds, steps=60, threads=2)
    assert sum(resets(expected)) >= 3 * len(seeds)


CONFIGURATIONS = {
    "one lane": {"lanes_count": 1},
    "dense": {"vehicles_density": 2.5, "ego_spacing": 1},
    "a given lane": {"initial_lane_id": 2},
    "more steps": {"policy_frequency": 5, "simulation_frequency": 15},
    "an end off the road": {"offroad_terminal": True, "action": {"type": "ContinuousAction"}},
    "other rewards": {
        "normalize_reward": False, "collision_reward": -5, "reward_speed_range": [15, 28],
        "on_road_reward": 0.5, "right_lane_reward": 0,
    },
    "connected lanes": {"neighbour_vehicles_connected_lanes": True},
    "only speeds": {"action": {"type": "DiscreteMetaAction", "lateral": False}},
    "other speeds": {"action": {"type": "DiscreteMetaAction", "target_speeds": [10, 15, 20, 25]}},
    "nobody else": {"vehicles_count": 0},
    "throttle": {"action": {"type": "ContinuousAction", "lateral": False}},
    "steering": {"action": {"type": "ContinuousAction", "longitudinal": False}},
    "dynamical": {"action": {"type": "ContinuousAction", "dynamical": True}},
    "limited": {"action": {"type": "ContinuousAction", "speed_range": [5, 12]}},
    "discrete": {"action": {"type": "DiscreteAction", "actions_per_axis": 4}},
    "aggressive": {"other_vehicles_type": "highway_env.vehicle.behavior.AggressiveVehicle"},
    "defensive": {"other_vehicles_type": "highway_env.vehicle.behavior.DefensiveVehicle"},
    "linear": {"other_vehicles_type": "highway_env.vehicle.behavior.LinearVehicle"},
}  # fmt: skip


ORDINARY = {"dense", "dynamical", "aggressive", "discrete"}


@pytest.mark.parametrize("name", some_slow(CONFIGURATIONS, ORDINARY))
def test_configurations_of_the_highway(name):
    expected = compare(
        "esc_gym/highway-v0", {**FEW, **CONFIGURATIONS[name]}, seeds=range(3), steps=16
    )
    assert sum(resets(expected)) > 3


# Steps over which there are some resets.
SCENARIOS = {
    "exit-v0": 40, "exit-v1": 25, "merge-v0": 50, "merge-v1": 40, "merge-generic-v0": 50,
    "merge-generic-v1": 40, "two-way-v0": 40, "u-turn-v0": 40, "u-turn-v1": 40,
    "roundabout-v0": 40, "roundabout-v1": 40, "roundabout-generic-v0": 40,
    "roundabout-generic-v1": 40, "intersection-v0": 30, "intersection-v1": 30,
    "intersection-v2": 30, "racetrack-v0": 60, "racetrack-v1": 60, "racetrack-large-v0": 60,
    "racetrack-large-v1": 40, "racetrack-oval-v0": 60, "racetrack-oval-v1": 60, "parking-v0": 40,
    "parking-parked-v0": 40, "parking-ActionRepeat-v0": 20, "lane-keeping-v0": 60,
}  # fmt: skip
# One of each family; the others are slow.
FIRST = {
    "exit-v0", "merge-generic-v1", "two-way-v0", "u-turn-v1", "roundabout-generic-v1",
    "intersection-v0", "racetrack-oval-v1", "parking-parked-v0", "lane-keeping-v0",
}  # fmt: skip


# Of these an episode may take hundreds of steps.
ENDLESS = {"parking-v0", "parking-parked-v0", "parking-ActionRepeat-v0", "lane-keeping-v0"}


@pytest.mark.parametrize("name", some_slow(SCENARIOS, FIRST))
def test_scenarios_over_resets(name):
    limit = {"max_episode_steps": 12} if name in ENDLESS else {}
    steps = SCENARIOS[name]
    expected = compare(f"esc_gym/{name}", seeds=range(3), steps=steps, threads=2, **limit)
    assert sum(resets(expected)) >= 6


OBSERVATIONS = {
    "shuffled": {"order": "shuffled"},
    "nearest first": {"order": "distance", "max_vehicles": 4},
    "too few rows": {"max_vehicles": 3, "order": "shuffled"},
    "body frame": {"frame": "ego"},
    "near": {"perception_distance": 30.0, "empty": "virtual"},
    "ranges": {"ranges": {"x": (-50, 80), "speed": (10, 20)}},
    "columns": {
        "features": ["vy", "x", "cos_d", "sin_d", "width", "length"],
        "ego_features": ["yaw_rate", "dest_x", "dest_y", "target_speed", "lateral_speed"],
    },
    "closeness": {
        "features": [
            "near_x",
            "near_y",
            "ahead",
            "behind",
            "left",
            "right",
            "urgency",
            "urgency_left",
            "urgency_right",
        ],
        "frame": "ego",
    },
}


@pytest.mark.filterwarnings("ignore:.*max_vehicles")
@pytest.mark.parametrize("name", OBSERVATIONS)
def test_observations(name):
    compare("esc_gym/highway-v0", FEW, seeds=range(2), steps=10, **OBSERVATIONS[name])
