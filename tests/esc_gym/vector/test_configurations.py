"""Batches of every id in random configurations, against stock environments.

``make exact`` runs more of them, each with 16 environments.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import load_env_creator

from esc_gym.features import VEHICLE_FEATURES
from esc_gym.registration import ENV_IDS, NAMESPACE
from esc_gym.scenarios import scenario_of_class
from tests.esc_gym.vector.stock import compare, resets

LIMIT = 8  # policy steps until an episode is truncated, if it has not ended
SIMPLE = "highway_env.vehicle.behavior."

# What a key of a configuration may be; keys that end in _reward may be anything.
DRAWN: dict[str, Any] = {
    "vehicles_count": lambda rng: int(rng.integers(0, 14)),
    "initial_vehicle_count": lambda rng: int(rng.integers(0, 12)),
    "other_vehicles": lambda rng: int(rng.integers(0, 5)),
    "lanes_count": lambda rng: int(rng.integers(2, 7)),
    "initial_lane_id": lambda rng: int(rng.integers(0, 2)),
    "vehicles_density": lambda rng: float(rng.uniform(0.5, 2.5)),
    "ego_spacing": lambda rng: float(rng.uniform(1, 3)),
    "duration": lambda rng: float(rng.uniform(1, 9)),
    "spawn_probability": lambda rng: float(rng.uniform(0, 1)),
    "reward_speed_range": lambda rng: sorted(rng.uniform(0, 40, 2).tolist()),
    "simulation_frequency": lambda rng: int(rng.choice([5, 10, 12, 20])),
    "policy_frequency": lambda rng: int(rng.choice([1, 2, 5])),
    "left_lane_constraint": lambda rng: float(rng.uniform(0, 1)),
    "lane_centering_cost": lambda rng: float(rng.uniform(0, 8)),
    "success_goal_reward": lambda rng: float(rng.uniform(0, 1)),
    "other_vehicles_type": lambda rng: SIMPLE + str(
        rng.choice(["IDMVehicle", "AggressiveVehicle", "DefensiveVehicle", "LinearVehicle"])
    ),
    **dict.fromkeys(
        ("normalize_reward", "offroad_terminal", "terminate_off_road", "add_walls",
         "neighbour_vehicles_connected_lanes"),
        lambda rng: bool(rng.integers(2)),
    ),
}  # fmt: skip


def drawn_config(env_id: str, rng: np.random.Generator) -> dict[str, Any]:
    """A random configuration, of which about half is the id's own."""
    env_class: Any = load_env_creator(str(gym.registry[env_id].entry_point))
    default = env_class.default_config()
    config = {}
    for key, value in default.items():
        if rng.random() < 0.5:
            continue
        if key in DRAWN:
            config[key] = DRAWN[key](rng)
        elif key.endswith("_reward") and isinstance(value, int | float):
            config[key] = float(rng.uniform(-2, 2))
    if env_id == "lane-keeping-v0":  # its policy steps are short
        config.setdefault("policy_frequency", 5)
    if env_id.startswith("racetrack"):
        config.pop("other_vehicles_type", None)  # they make IDMVehicles
    scenario = scenario_of_class(env_class)
    assert scenario
    if rng.random() < 0.5:
        config["action"] = drawn_action(default["action"], rng, bool(scenario.discrete_only))
        if env_id == "lane-keeping-v0":
            config["action"]["dynamical"] = True
    return config


def drawn_action(
    default: dict[str, Any], rng: np.random.Generator, discrete: bool
) -> dict[str, Any]:
    """A random action type that the id's roads are for."""
    if default["type"] == "DiscreteMetaAction" and (discrete or rng.random() < 0.5):
        return {"target_speeds": sorted(rng.uniform(0, 35, rng.integers(2, 6)).tolist())}
    axis = rng.choice(["longitudinal", "lateral", "neither"])
    return {
        "type": "ContinuousAction", "dynamical": bool(rng.integers(2)),
        "longitudinal": axis != "lateral", "lateral": axis != "longitudinal",
    }  # fmt: skip


def drawn_observation(rng: np.random.Generator) -> dict[str, Any]:
    """Random arguments of ``SetObservation``."""
    return {
        "order": str(rng.choice(["road", "shuffled", "distance"])),
        "perception_distance": float(rng.uniform(20, 250)),
        "frame": str(rng.choice(["world", "ego"])),
        "empty": str(rng.choice(["zeros", "virtual"])),
        "features": [str(name) for name in rng.permutation(list(VEHICLE_FEATURES))[:9]],
    }


ORDINARY = {"highway-fast-v0", "merge-v1", "intersection-v0", "racetrack-v0", "parking-v0"}


@pytest.mark.filterwarnings("ignore:.*is out of date")
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in ORDINARY else pytest.mark.slow)
        for name in (env_id.removeprefix(f"{NAMESPACE}/") for env_id in ENV_IDS)
    ],
)
def test_as_stock(name, drawn, request):
    count = 16 if request.config.getoption("exact_seeds", None) else 3
    rng = np.random.default_rng([drawn, *name.encode()])
    config, observation = {}, {}
    if drawn:
        config, observation = drawn_config(name, rng), drawn_observation(rng)
        if name.startswith("parking"):
            observation["goal"] = True
    expected = compare(
        f"{NAMESPACE}/{name}", config, seeds=range(100 * drawn, 100 * drawn + count),
        steps=4 * (LIMIT + 1), threads=1 + drawn % 2, disturbed=True, max_episode_steps=LIMIT,
        **observation,
    )  # fmt: skip
    assert min(resets(expected)) >= 4
