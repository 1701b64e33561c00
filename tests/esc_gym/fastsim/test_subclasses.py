"""Classes of users' own: compiled only where they change nothing of what the kernels compute."""

from __future__ import annotations

from functools import partial

import pytest
from highway_env.envs.highway_env import HighwayEnvFast
from highway_env.road.lane import StraightLane
from highway_env.road.road import Road
from highway_env.vehicle.behavior import IDMVehicle

from tests.esc_gym.fastsim.lockstep import lockstep
from tests.esc_gym.fastsim.test_scenes import Scene, ordinary_traffic, others
from tests.esc_gym.fastsim.test_users import method_of_one


class Sleepy(IDMVehicle):
    """Overrides what the kernels compute."""

    def desired_gap(self, ego_vehicle, front_vehicle=None, projected=True):
        return 2 * super().desired_gap(ego_vehicle, front_vehicle, projected)


class Named(IDMVehicle):
    """Overrides nothing that they compute."""

    TIME_WANTED = 2.5

    def __str__(self):
        return "Named"


class Icy(Road):
    def step(self, dt):
        super().step(1.01 * dt)


class Banked(StraightLane):
    def heading_at(self, longitudinal):
        return self.heading + 1e-3


def traffic_of(cls):
    def change(env):
        env.road.vehicles[1:] = [cls.create_from(vehicle) for vehicle in others(env)]

    return ordinary_traffic(change)


def on_road_of(cls):
    def change(env):
        road = env.road
        env.road = cls(road.network, road.vehicles, road.objects, np_random=env.np_random)
        for vehicle in road.vehicles:
            vehicle.road = env.road

    return ordinary_traffic(change)


def banked(env):
    lane = env.road.network.get_lane(("0", "1", 1))
    env.road.network.graph["0"]["1"][1] = Banked(lane.start, lane.end, speed_limit=30)
    for vehicle in env.road.vehicles:
        vehicle.on_state_update()


@pytest.mark.parametrize(
    ("build", "compiled"),
    [
        (traffic_of(Sleepy), False),
        (traffic_of(Named), True),
        (on_road_of(Icy), False),
        (ordinary_traffic(banked), False),
        (ordinary_traffic(method_of_one), False),
    ],
    ids=["vehicle", "harmless vehicle", "road", "lane", "method"],
)
def test_classes_of_their_own(build, compiled):
    lockstep(partial(Scene, build), steps=5, compiled=compiled)


class SlowMotion(HighwayEnvFast):
    def _simulate(self, action=None):
        super()._simulate(action)
        super()._simulate(None)


def test_simulate_of_their_own():
    lockstep(SlowMotion, steps=4, compiled=False)
