"""Under the set observation highway-env drives as ever, and computes none of its own."""

from __future__ import annotations

import gymnasium as gym
import highway_env  # noqa: F401
import numpy as np
import pytest
from highway_env.envs.common.observation import observation_factory
from highway_env.vehicle.behavior import IDMVehicle

from esc_gym.fastsim.behavior import original_behavior


@pytest.fixture(autouse=True)
def _fresh_classes():
    """Stock intersections change IDMVehicle for the whole process, for later tests too."""
    with original_behavior(IDMVehicle):
        yield


def test_trajectories_are_highway_envs_own():
    """The wrapper changes what is observed, nothing else: rewards, flags, generator, positions."""
    for base_id in ("highway-fast-v0", "intersection-v0", "parking-v0", "lane-keeping-v0"):
        stock = gym.make(base_id)
        # The order draws random numbers, but never the simulator's.
        ours = gym.make(f"esc_gym/{base_id}", order="shuffled")
        stock.reset(seed=4)
        ours.reset(seed=4)
        # Stock observations of lane keeping draw noise from the simulator's generator; ours do not.
        compare_generator = base_id != "lane-keeping-v0"
        for _ in range(8):
            ours.action_space.seed(1)
            action = ours.action_space.sample()
            _, reward, terminated, truncated, _ = stock.step(action)
            _, *mine, _ = ours.step(action)
            assert mine == [reward, terminated, truncated]
            for a, b in zip(
                stock.unwrapped.road.vehicles, ours.unwrapped.road.vehicles, strict=True
            ):
                assert (a.position == b.position).all()
                assert (a.speed, a.heading) == (b.speed, b.heading)
            if compare_generator:
                assert (
                    stock.unwrapped.np_random.bit_generator.state
                    == ours.unwrapped.np_random.bit_generator.state
                )
            if terminated:
                break


def test_the_stock_observation_is_never_computed(monkeypatch):
    from highway_env.envs.common import observation

    def paid(self):
        raise AssertionError("pandas observation computed")

    envs = [gym.make(f"esc_gym/{i}") for i in ("highway-fast-v0", "exit-v0", "parking-v0")]
    monkeypatch.setattr(observation.KinematicObservation, "observe", paid)
    monkeypatch.setattr(observation.ExitObservation, "observe", paid)
    monkeypatch.setattr(observation.KinematicsGoalObservation, "observe", paid)
    for env in envs:
        env.reset(seed=0)
        env.step(env.action_space.sample())


def test_parking_goal_observation_equals_stock_bit_for_bit():
    env = gym.make("esc_gym/parking-v0")
    env.reset(seed=0)
    env.step(np.array([0.3, 0.2], dtype=np.float32))
    base = env.unwrapped
    stock = observation_factory(base, base.PARKING_OBS["observation"]).observe()
    mine = base.observation_type_parking.observe()
    assert stock.keys() == mine.keys()
    for key, value in stock.items():
        assert (value == mine[key]).all()
