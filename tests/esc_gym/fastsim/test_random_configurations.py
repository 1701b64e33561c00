"""Configurations that nobody thought of."""

from __future__ import annotations

from functools import partial

import gymnasium as gym
from hypothesis import HealthCheck, Phase, given, seed, settings, strategies as st

from tests.esc_gym.fastsim.lockstep import lockstep

DRIVERS = [
    f"highway_env.vehicle.behavior.{name}Vehicle"
    for name in ("IDM", "Linear", "Aggressive", "Defensive")
]

META = st.fixed_dictionaries(
    {"type": st.just("DiscreteMetaAction")},
    optional={"target_speeds": st.lists(st.integers(0, 40), min_size=2, max_size=5, unique=True)},
)
CONTINUOUS = st.fixed_dictionaries(
    {"type": st.sampled_from(["ContinuousAction", "DiscreteAction"])},
    optional={
        "dynamical": st.booleans(),
        "clip": st.booleans(),
        "acceleration_range": st.sampled_from([[-5, 5], [-12.5, 3]]),
        "steering_range": st.sampled_from([[-0.1, 0.1], [-1.2, 1.2]]),
        "speed_range": st.sampled_from([[0, 10], [-5.5, 33]]),
    },
)
ONE_AXIS = CONTINUOUS.map(lambda action: action | {"lateral": False})

COMMON = {
    "other_vehicles_type": st.sampled_from(DRIVERS),
    "neighbour_vehicles_connected_lanes": st.booleans(),
    "simulation_frequency": st.sampled_from([5, 7, 10, 15]),
    "policy_frequency": st.sampled_from([1, 2, 3, 5]),
}
# id: action types that work there, and what else can be drawn
ENVIRONMENTS = {
    "highway-fast-v0": (
        META | CONTINUOUS,
        {
            "lanes_count": st.integers(1, 6),
            "vehicles_count": st.integers(0, 25),
            "vehicles_density": st.floats(0.5, 3),
            "ego_spacing": st.floats(0.3, 2),
        },
    ),
    "merge-generic-v0": (
        META | ONE_AXIS,
        {
            "lanes_count": st.integers(1, 5),
            "vehicles_count": st.integers(0, 12),
            "before_merge_length": st.floats(60, 200),
            "converge_merge_length": st.floats(20, 90),
            "parallel_merge_length": st.floats(20, 90),
        },
    ),
    "roundabout-generic-v0": (
        META | ONE_AXIS,
        {
            "roundabout_lanes": st.integers(1, 4),
            "roundabout_radius": st.integers(12, 40),
            "vehicles_count": st.integers(0, 10),
        },
    ),
    "intersection-v0": (
        META | CONTINUOUS,
        {
            "initial_vehicle_count": st.integers(1, 12),
            "spawn_probability": st.floats(0, 1),
            "destination": st.sampled_from([None, "o1", "o2", "o3"]),
        },
    ),
    "exit-v0": (
        META | CONTINUOUS,
        {
            "lanes_count": st.integers(2, 6),
            "vehicles_count": st.integers(0, 20),
            "vehicles_density": st.floats(0.5, 3),
        },
    ),
    "racetrack-oval-v0": (
        CONTINUOUS,
        {
            "no_lanes": st.integers(2, 5),
            "other_vehicles": st.integers(0, 5),
            "length": st.integers(60, 200),
            "block_lane": st.booleans(),
            "force_decision": st.booleans(),
        },
    ),
}


@st.composite
def environments(draw):
    env_id = draw(st.sampled_from(sorted(ENVIRONMENTS)))
    actions, options = ENVIRONMENTS[env_id]
    return env_id, draw(st.fixed_dictionaries({"action": actions}, optional=COMMON | options))


def test_any_configuration(seeds):
    @seed(seeds[0])
    @settings(
        max_examples=15,
        deadline=None,
        database=None,
        phases=[Phase.generate],  # what it finds is printed whole; to shrink it takes minutes
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )
    @given(environment=environments(), episode=st.integers(0, 10_000))
    def run(environment, episode):
        env_id, config = environment
        lockstep(partial(gym.make, env_id, config=config), seeds=[episode], steps=6)

    run()
