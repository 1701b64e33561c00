"""What users do to an environment between its steps, and classes of their own.

Each must be simulated exactly, compiled or not: whatever the kernels cannot know, stock code runs.
"""

from __future__ import annotations

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from highway_env.road.lane import StraightLane
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Obstacle

import esc_gym
from esc_gym import SetObservation
from tests.esc_gym.fastsim.lockstep import crashed, happened, lockstep
from tests.esc_gym.fastsim.test_scenes import others


class Meddler(gym.Wrapper):
    """Calls ``change(env.unwrapped)`` before some steps of each episode."""

    def __init__(self, env, change, when=(2, 4)):
        super().__init__(env)
        self.change, self.when, self.steps = change, when, 0

    def reset(self, **arguments):
        self.steps = 0
        return super().reset(**arguments)

    def step(self, action):
        self.steps += 1
        if self.steps in self.when:
            self.change(self.unwrapped)
        return super().step(action)


def meddled(env_id, change):
    return Meddler(gym.make(env_id), change)


def add(env, at=None):
    ego = env.vehicle
    lane = (*ego.lane_index[:2], 0)
    x = env.road.network.get_lane(lane).local_coordinates(ego.position)[0]
    vehicle = IDMVehicle.make_on_lane(env.road, lane, x + 20, speed=8.0)
    vehicle.route = [lane]  # an intersection takes vehicles without one off the road
    vehicles = env.road.vehicles
    vehicles.insert(len(vehicles) if at is None else at, vehicle)


def on_each(**attributes):
    """A change: these attributes to every second vehicle of the traffic."""
    return lambda env: [vars(vehicle).update(attributes) for vehicle in others(env)[::2]]


def on_lanes(**attributes):
    return lambda env: [vars(lane).update(attributes) for lane in env.road.network.lanes_list()]


def new_lane(env):
    network = env.road.network
    lane = network.graph["0"]["1"][-1]
    side = [0, StraightLane.DEFAULT_WIDTH]
    network.add_lane("0", "1", StraightLane(lane.start + side, lane.end + side, speed_limit=30))


def new_network(env):
    """Another network object with other lanes, and everybody on it."""
    env.road.network = RoadNetwork.straight_road_network(4, speed_limit=15)
    for vehicle in env.road.vehicles:
        vehicle.on_state_update()
        if hasattr(vehicle, "target_lane_index"):
            vehicle.target_lane_index = vehicle.lane_index


def brake_hard(self, action=None):
    self.action = {"steering": 0.0, "acceleration": -4.0}


def method_of_one(env):
    for vehicle in others(env)[:2]:
        vehicle.act = brake_hard.__get__(vehicle)


def teleport(env):
    for vehicle in others(env)[::2]:
        vehicle.position += (7.0, 0.0)
        vehicle.on_state_update()


def nudge(env):
    """Without telling the vehicle: its lane stays what it was."""
    for vehicle in others(env)[::2]:
        vehicle.position[1] += 0.01


def zeros_with_a_sign(env):
    for vehicle in env.road.vehicles:
        vehicle.heading = -0.0
        vehicle.position[vehicle.position == 0.0] = -0.0


def other_lanes(env):
    """Everybody wants to the first lane of the road."""
    for vehicle in others(env):
        vehicle.target_lane_index = (*vehicle.lane_index[:2], 0)


def other_routes(env):
    """Once around the roundabout, or off at the next exit."""
    for vehicle in others(env):
        vehicle.plan_route_to(["wxr", "exr"][env.steps // 15 % 2])


CHANGES = {
    "nudge": nudge,
    "zeros with a sign": zeros_with_a_sign,
    "other lanes": other_lanes,
    "timers": on_each(timer=0.9),
    "impact": on_each(impact=np.array([0.5, -0.1])),
    "another position": lambda env: [
        vars(vehicle).update(position=vehicle.position + 0.5) for vehicle in others(env)[::2]
    ],
    "an action": lambda env: [vehicle.action.update(steering=0.3) for vehicle in others(env)],
    "teleport": teleport,
    "add": add,
    "add as the first": partial(add, at=0),
    "remove": lambda env: env.road.vehicles.pop(),
    "remove the ego": lambda env: setattr(env.road, "vehicles", others(env)),
    "swap": lambda env: env.road.vehicles.reverse(),
    "obstacle": lambda env: env.road.objects.append(
        Obstacle(env.road, env.vehicle.position + np.array([15.0, 0.0]))
    ),
    "speed": on_each(speed=12),
    "float32 speed": on_each(speed=np.float32(12.3)),
    "target speed": on_each(target_speed=np.float32(17.3)),
    "target speed of the ego": lambda env: setattr(env.vehicle, "target_speed", np.float32(22.3)),
    "politeness": on_each(POLITENESS=0.5, LANE_CHANGE_MIN_ACC_GAIN=0.01),
    "reckless": on_each(DISTANCE_WANTED=1.0, COMFORT_ACC_MIN=-9.0),
    "crash": on_each(crashed=True),
    "no lane changes": on_each(enable_lane_change=False),
    "method": method_of_one,
    "limits": on_lanes(speed_limit=11.0),
    "widths": on_lanes(width=1.0),
    "forbidden": on_lanes(forbidden=True),
    "frequencies": lambda env: env.config.update(simulation_frequency=10, policy_frequency=2),
    "connected": lambda env: vars(env.road).update(neighbour_vehicles_connected_lanes=True),
}


@pytest.mark.parametrize(
    "env_id",
    [
        "highway-fast-v0",
        pytest.param("merge-v0", marks=pytest.mark.slow),
        pytest.param("intersection-v0", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("name", CHANGES)
def test_changes_between_steps(name, env_id):
    lockstep(partial(meddled, env_id, CHANGES[name]), steps=6, seeds=[1], compiled=None)


def test_routes_that_change_between_steps():
    make = partial(gym.make, "roundabout-v0")
    lockstep(lambda: Meddler(make(), other_routes, when=range(2, 12)), steps=12, seeds=range(4))


@pytest.mark.parametrize("change", [new_lane, new_network])
def test_changes_of_the_network(change):
    lockstep(partial(meddled, "highway-fast-v0", change), steps=6, seeds=[1], compiled=None)


@pytest.mark.parametrize(
    ("env_id", "cls", "name", "value"),
    [
        ("highway-fast-v0", IDMVehicle, "POLITENESS", 0.4),
        ("highway-fast-v0", IDMVehicle, "LANE_CHANGE_DELAY", 0.5),
        ("highway-fast-v0", Vehicle, "MAX_SPEED", 9.0),
        ("highway-fast-v0", IDMVehicle, "desired_gap", lambda *vehicles, projected=True: 30.0),
        ("highway-fast-v0", StraightLane, "on_lane", lambda *place, margin=0: True),
        ("intersection-v0", RegulatedRoad, "YIELDING_COLOR", (200, 0, 0)),
        ("intersection-v0", RegulatedRoad, "YIELD_DURATION", 1.0),
        ("intersection-v0", RegulatedRoad, "REGULATION_FREQUENCY", 4),
    ],
)
def test_changed_classes(env_id, cls, name, value, monkeypatch):
    make = partial(gym.make, env_id)
    plain = lockstep(make, steps=5, seeds=[0])
    monkeypatch.setattr(cls, name, value)
    changed = lockstep(make, steps=5, seeds=[0], compiled=None)
    assert str(plain) != str(changed)


def test_classes_that_change_between_steps(monkeypatch):
    """A constant of a driver's class, there and back."""
    monkeypatch.setattr(IDMVehicle, "TIME_WANTED", IDMVehicle.TIME_WANTED)

    def toggle(env):
        IDMVehicle.TIME_WANTED = 2.0 - IDMVehicle.TIME_WANTED

    make = partial(gym.make, "highway-fast-v0")
    changed = lockstep(lambda: Meddler(make(), toggle), steps=6, seeds=[1])
    assert str(changed) != str(lockstep(make, steps=6, seeds=[1]))


def test_trajectories_are_recorded():
    config = {"show_trajectories": True}
    recording = lockstep(partial(gym.make, "merge-v0", config=config), steps=4, compiled=False)
    assert happened(recording, lambda thing: thing.get("history"))


def test_two_at_once():
    """Nothing is shared between environments of one process."""

    def ours():
        other = esc_gym.accelerate(gym.make("merge-v0"))
        other.reset(seed=9)
        env = esc_gym.accelerate(gym.make("merge-v0"))
        return Meddler(env, lambda _: other.step(0))

    lockstep(partial(gym.make, "merge-v0"), ours)


def test_accelerated_twice():
    make = partial(gym.make, "merge-v0")
    lockstep(make, lambda: esc_gym.accelerate(esc_gym.accelerate(make())), steps=4)


class Filmed(gym.Wrapper):
    """A frame of every step in its info; highway-env then also draws the sub-steps."""

    def step(self, action):
        *returned, info = super().step(action)
        return *returned, info | {"frame": self.render()}


def test_rendered(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    make = partial(gym.make, "merge-v0", render_mode="rgb_array")
    lockstep(lambda: Filmed(make()), lambda: Filmed(esc_gym.accelerate(make())), compiled=None)


class Reconfigured(gym.Wrapper):
    """Every episode with another road, other traffic and other frequencies."""

    def reset(self, *, seed=None, options=None):
        driver = ["IDMVehicle", "AggressiveVehicle"][seed % 2]
        config = {
            "lanes_count": 2 + seed,
            "vehicles_count": 12 - 2 * seed,
            "other_vehicles_type": f"highway_env.vehicle.behavior.{driver}",
            "simulation_frequency": 5 + 3 * seed,
        }
        return super().reset(seed=seed, options={"config": config})


def test_configured_by_reset():
    make = partial(gym.make, "highway-fast-v0")
    lockstep(lambda: Reconfigured(make()), seeds=range(4), steps=5)


class Rebuilt(gym.Wrapper):
    """Every other episode on a road of the same lanes in other places."""

    def __init__(self, env, name, change):
        super().__init__(env)
        self.name, self.change = name, change

    def reset(self, *, seed=None, options=None):
        returned = super().reset(seed=seed, options=options)
        for lane in self.unwrapped.road.network.lanes_list():
            if seed % 2 and hasattr(lane, self.name):
                setattr(lane, self.name, getattr(lane, self.name) + self.change)
        return returned


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("start", np.array([0.0, 0.1])),
        ("heading", 0.01),
        ("radius", 0.1),
        ("center", np.array([0.1, 0.0])),
        ("amplitude", 0.1),
        ("width", -0.5),
    ],
)
def test_roads_rebuilt_elsewhere(name, change):
    make = partial(gym.make, "roundabout-v0")
    lockstep(lambda: Rebuilt(make(), name, change), seeds=range(3), steps=6)


@pytest.mark.parametrize("env_id", ["highway-fast-v0", "intersection-v1", "parking-v0"])
def test_the_set_observation(env_id):
    config = {"config": {"duration": 10}} if env_id != "parking-v0" else {}
    make = partial(gym.make, f"esc_gym/{env_id}", **config)
    recording = lockstep(partial(make, accelerate=False), make, steps=12)
    assert set(recording[0][1]["observation"]) == {"ego", "vehicles", "mask"}
    stock = partial(gym.make, env_id, **config)
    lockstep(
        lambda: SetObservation(stock(), accelerate=False), lambda: SetObservation(stock()), steps=4
    )
    assert happened(recording, crashed) or env_id == "parking-v0"
