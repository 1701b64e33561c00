"""Roads and traffic that no environment of highway-env makes: lanes of every kind, routes with lane
numbers, things in the way, and states at the edge of what a simulation meets."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from highway_env.envs.highway_env import HighwayEnvFast
from highway_env.road.lane import CircularLane, PolyLane, PolyLaneFixedWidth, SineLane, StraightLane
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import AggressiveVehicle, IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.dynamics import BicycleVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, Obstacle

from tests.esc_gym.fastsim.lockstep import changing_lane, crashed, happened, lockstep

Build = Callable[[Any], None]


class Scene(HighwayEnvFast):
    """A highway-env environment whose road and vehicles ``build(env)`` makes."""

    def __init__(self, build: Build, config: dict[str, Any] | None = None) -> None:
        self.build = build
        super().__init__(config)

    def _reset(self) -> None:
        self.build(self)


def straight(env, lanes=3, length=10_000.0, road=Road):
    network = RoadNetwork.straight_road_network(lanes, length=length, speed_limit=25)
    env.road = road(network, np_random=env.np_random)


def put(env, cls, x, lane=0, start="0", end="1", speed=20.0, **attributes):
    """A vehicle or object on a lane; the first one whose ``cls`` is None is the ego."""
    index = (start, end, lane)
    ego = cls is None
    position = env.road.network.get_lane(index).position(x, 0)
    heading = env.road.network.get_lane(index).heading_at(x)
    thing = (env.action_type.vehicle_class if ego else cls)(env.road, position, heading, speed)
    (env.road.objects if isinstance(thing, Obstacle | Landmark) else env.road.vehicles).append(
        thing
    )
    if ego:
        env.controlled_vehicles = [thing]
    vars(thing).update(attributes)
    return thing


def curve(y):
    """Points of a bend that starts and ends in the direction of x, 60 m long."""
    return [(x, y + 3 * np.sin(np.pi * (x - 120) / 60) ** 2) for x in range(120, 185, 5)]


def every_kind_of_lane(env):
    """Straight, sine, spline, spline of measured width, and circle, one after the other."""
    network = RoadNetwork()
    for y in (0.0, 4.0):
        limit = {"speed_limit": 18.0 if y else None}
        network.add_lane("a", "b", StraightLane([0, y], [60, y], **limit))
        network.add_lane("b", "c", SineLane([60, y], [120, y], 2.0, 2 * np.pi / 60, 0, **limit))
        network.add_lane("c", "d", PolyLaneFixedWidth(curve(y), **limit))
        moved = [[(px + 60, py + dy) for px, py in curve(y)] for dy in (0, -2.5, 2.5)]
        network.add_lane("d", "e", PolyLane(*moved, **limit))
        arc = CircularLane([240, 50], 50 - y, -np.pi / 2, 0, **limit)
        network.add_lane("e", "f", arc)
    connected = env.config["neighbour_vehicles_connected_lanes"]
    env.road = Road(network, np_random=env.np_random, neighbour_vehicles_connected_lanes=connected)
    put(env, None, 20, 0, "a", "b")
    traffic = AggressiveVehicle if env.config["aggressive"] else IDMVehicle
    for start, end in ("ab", "bc", "cd", "de", "ef"):
        for x, lane, speed in (5, 0, 16.0), (30, 0, 4.0), (45, 1, 9.0):  # the first is held up
            x += env.np_random.uniform(-3, 3)
            put(env, traffic, x, lane, start, end, speed, timer=0.9).randomize_behavior()


@pytest.mark.parametrize("aggressive", [False, True])
@pytest.mark.parametrize("connected", [False, True])
def test_every_kind_of_lane(connected, aggressive):
    config = {"neighbour_vehicles_connected_lanes": connected, "aggressive": aggressive}
    recording = lockstep(partial(Scene, every_kind_of_lane, config), steps=8)
    for road in ("ab", "bc", "cd", "de", "ef"):
        assert happened(recording, lambda t, road=road: t["lane_index"][:2] == tuple(road))
    assert happened(recording, changing_lane) or connected or aggressive


def ordinary_traffic(change: Build) -> Build:
    """highway-fast's own scene, then ``change(env)``."""

    def build(env):
        HighwayEnvFast._reset(env)
        change(env)

    return build


def others(env):
    return env.road.vehicles[1:]


def every(**attributes) -> Build:
    """The attributes of each third of the traffic."""

    def build(env):
        for vehicle in others(env)[::3]:
            vars(vehicle).update(attributes)

    return ordinary_traffic(build)


def routes_with_lanes(env):
    HighwayEnvFast._reset(env)
    for number, vehicle in enumerate(others(env)):
        vehicle.route = [("0", "1", number % 3)]
        vehicle.LANE_CHANGE_MAX_BRAKING_IMPOSED = 1000  # as set_preferred_lane does


def one_route_for_all(env):
    """A list that whoever passes the end of a road shortens for all."""
    network = RoadNetwork()
    for number in range(4):
        for y in (0, 4):
            start, end = [60 * number, y], [60 * number + 60, y]
            network.add_lane(str(number), str(number + 1), StraightLane(start, end))
    env.road = Road(network, np_random=env.np_random)
    put(env, None, 5)
    route = [("0", "1", 0), ("1", "2", 1), ("2", "3", None), ("3", "4", 0)]
    for x in (15, 30, 45):
        put(env, IDMVehicle, x, x % 2, route=route)


def things_in_the_way(env):
    HighwayEnvFast._reset(env)
    ego = env.vehicle.position[0]
    for number, cls in enumerate([Obstacle, Landmark] * 6):
        put(env, cls, ego + 25 + 9 * number, number % 3, speed=0)


def intangible(env):
    """Pairs in one place, with all ways of not colliding."""
    straight(env)
    put(env, None, 20)
    for number in range(10):
        for shift, cls in (0, IDMVehicle), (3, [Vehicle, Obstacle, Landmark][number % 3]):
            thing = put(env, cls, 60 + 40 * number + shift, speed=20.0 - shift)
            thing.solid, thing.collidable, thing.check_collisions = env.np_random.random(3) < 0.6


def twins(env):
    """Two at one place, two side by side, two at one distance: who is in front of whom?"""
    straight(env)
    put(env, None, 50, 1)
    for x, lane in [(70, 1), (70, 1), (70, 0), (70, 2), (30, 1), (30, 1), (50, 0), (50, 1)]:
        put(env, IDMVehicle, x, lane, speed=20.0, timer=0.9)
    put(env, Obstacle, 70, 1, speed=0)


def end_of_the_road(env):
    straight(env, length=100.0)
    put(env, None, 60, 1)
    for x, lane in [(80, 0), (96, 0), (99, 1), (103, 1), (150, 2), (-3, 0), (-20, 1), (20, 2)]:
        put(env, IDMVehicle, x, lane, speed=15.0)


def off_the_road(env):
    straight(env)
    put(env, None, 50)
    env.vehicle.position[1] = -30.0
    put(env, IDMVehicle, 60).position[1] = 40.0
    put(env, IDMVehicle, 80, 1).position[1] += 2.0  # between two lanes
    for x in (20, 100, 120):
        put(env, IDMVehicle, x, 2)


def odd_states(env):
    straight(env)
    put(env, None, 50, speed=0.0)
    odd = [
        {"speed": 0.0},
        {"speed": -5.0},
        {"speed": 60.0},
        {"speed": 1e-9},
        {"heading": np.pi},
        {"heading": 7.0},
        {"heading": -np.pi / 2},
        {"target_speed": 0.0},
        {"target_speed": -3.0},
        {"timer": 1.0},
        {"impact": np.array([0.5, -0.25])},
        {"crashed": True, "action": {"steering": 0.3, "acceleration": 2}},
        {"target_lane_index": ("0", "1", 2)},
    ]
    for number, attributes in enumerate(odd):
        put(env, IDMVehicle, 30 + 11 * number, number % 2, **attributes)


def every_kind_of_vehicle(env):
    straight(env)
    put(env, None, 20)
    kinds = [IDMVehicle, ControlledVehicle, MDPVehicle, BicycleVehicle, Vehicle, AggressiveVehicle]
    for number, cls in enumerate(kinds * 2):
        put(env, cls, 30 + 10 * number, number % 3, speed=26.0 - number)
    for vehicle in env.road.vehicles:
        if type(vehicle) in (Vehicle, BicycleVehicle):
            vehicle.action = {"steering": 0.01, "acceleration": -0.5}


def crossing(env):
    """Road rules for vehicles with and without a route."""
    network = RoadNetwork()
    network.add_lane("w", "e", StraightLane([-80, 0], [80, 0], priority=2))
    network.add_lane("s", "n", StraightLane([0, -80], [0, 80], priority=1))
    network.add_lane("s", "n", StraightLane([4, -80], [4, 80], priority=1))
    env.road = RegulatedRoad(network, np_random=env.np_random)
    put(env, None, 45, 0, "w", "e", speed=12.0)
    for x, lane, start, end in [(50, 0, "s", "n"), (42, 1, "s", "n"), (20, 0, "w", "e")]:
        put(env, IDMVehicle, x, lane, start, end, speed=10.0).plan_route_to(end)
    put(env, AggressiveVehicle, 15, 1, "s", "n", speed=13.0)
    put(env, Vehicle, 30, 0, "s", "n", speed=9.0, prediction_type="zero_steering")
    put(
        env, BicycleVehicle, 8, 0, "s", "n", speed=9.0, action={"steering": 0.02, "acceleration": 0}
    )


def empty_road(env):
    straight(env)
    put(env, None, 20)


TRUCK = {"LENGTH": 12.0, "WIDTH": 2.5, "diagonal": np.hypot(12.0, 2.5)}
TIMID = {"POLITENESS": 0.7, "TIME_WANTED": 3.0, "DELTA": 2.0, "ACC_MAX": 2.0, "MAX_SPEED": 23.0}
# build, steps, event
SCENES = {
    "routes with lanes": (routes_with_lanes, 8, changing_lane),
    "one route for all": (one_route_for_all, 10, lambda t: t.get("route") == [("3", "4", 0)]),
    "things in the way": (things_in_the_way, 8, lambda t: t["hit"]),
    "intangible": (intangible, 2, lambda t: t["hit"] and "timer" in t),
    "twins": (twins, 8, crashed),
    "end of the road": (end_of_the_road, 8, lambda t: t["position"][0] > 105),
    "off the road": (off_the_road, 8, lambda t: abs(t["position"][1]) > 20),
    "odd states": (odd_states, 10, crashed),
    "every kind of vehicle": (every_kind_of_vehicle, 10, changing_lane),
    "crossing": (crossing, 8, lambda t: t.get("is_yielding")),
    "empty road": (empty_road, 15, lambda t: t["class"] == "MDPVehicle"),
    "crashed": (every(crashed=True), 8, crashed),
    "keeping their lanes": (every(enable_lane_change=False), 8, changing_lane),
    "trucks": (every(**TRUCK), 8, changing_lane),
    "timid": (every(**TIMID), 8, changing_lane),
}


@pytest.mark.parametrize("name", SCENES)
def test_scene(name):
    build, steps, event = SCENES[name]
    assert happened(lockstep(partial(Scene, build), steps=steps), event)


def test_dynamical_ego_among_everything():
    config = {"action": {"type": "ContinuousAction", "dynamical": True}}
    recording = lockstep(partial(Scene, every_kind_of_vehicle, config), steps=10)
    assert happened(recording, lambda thing: thing["class"] == "BicycleVehicle")
