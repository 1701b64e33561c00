"""Copies of an environment in mid-episode: planning on them, pickles."""

from __future__ import annotations

import copy
import pickle

import gymnasium as gym
import pytest
from highway_env.envs.exit_env import ExitEnv
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.envs.u_turn_env import UTurnEnv

from tests.esc_gym.fastsim.lockstep import lockstep


class Planner(gym.Wrapper):
    """Continues on a copy of the environment, as tree search does."""

    def __init__(self, env, fork):
        super().__init__(env)
        self.fork = fork

    def step(self, action):
        before = self.env
        self.env = self.fork(before)
        before.step(action)  # the original must not share anything with the copy
        return self.env.step(action)


FORKS = {
    "copy": copy.deepcopy,
    "simplify": lambda env: env.simplify(),
    "aggressive": lambda env: env.change_vehicles("highway_env.vehicle.behavior.AggressiveVehicle"),
    "lane": lambda env: env.set_preferred_lane(1),
    "randomize": lambda env: env.randomize_behavior(),
    "field": lambda env: env.set_vehicle_field(("speed", 9.5)),
    "route": lambda env: env.set_route_at_intersection("random"),
}


@pytest.mark.parametrize("cls", [UTurnEnv, IntersectionEnv])
@pytest.mark.parametrize("name", FORKS)
def test_planning_on_copies(name, cls):
    if name == "lane" and cls is IntersectionEnv:
        cls = ExitEnv  # highway-env sends vehicles to lanes that an intersection does not have
    lockstep(lambda: Planner(cls(), FORKS[name]), steps=4, seeds=[1], compiled=None)


class Reloaded(gym.Wrapper):
    """Goes on with what pickle makes of the environment."""

    def step(self, action):
        self.env = pickle.loads(pickle.dumps(self.env))
        return self.env.step(action)


@pytest.mark.parametrize("id", ["highway-fast-v0", "intersection-v1", "parking-v0"])
def test_unpickled_environments_stay_compiled(id):
    lockstep(lambda: Reloaded(gym.make(id)), steps=6)
