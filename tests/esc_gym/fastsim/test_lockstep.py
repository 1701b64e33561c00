"""The comparison itself: it must find the smallest difference, wherever it is."""

from __future__ import annotations

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from tests.esc_gym.fastsim.lockstep import equal, lockstep

MERGE = partial(gym.make, "merge-v0")


class Faulty(gym.Wrapper):
    """The stock environment, with one fault in its third step."""

    def __init__(self, fault):
        super().__init__(MERGE())
        self.fault, self.steps = fault, 0

    def step(self, action):
        returned = list(super().step(action))
        self.steps += 1
        if self.steps == 3:
            self.fault(self.unwrapped, returned)
        return tuple(returned)


def one_ulp(env, returned):
    position = env.road.vehicles[2].position
    position[1] = np.nextafter(position[1], np.inf)


def other_lane_object(env, returned):
    vehicle = env.road.vehicles[1]
    vehicle.lane = type(vehicle.lane)(vehicle.lane.start, vehicle.lane.end)


def attribute(name, value, number=1):
    return lambda env, returned: setattr(env.road.vehicles[number], name, value)


def result(index, value):
    return lambda env, returned: returned.__setitem__(index, value)


FAULTS = {
    r"object 2 \(IDMVehicle\) position: .*": one_ulp,
    r"object 1 \(IDMVehicle\) lane: stock .lane ": other_lane_object,
    r"object 1 \(IDMVehicle\) extra: stock '\(missing\)', accelerated 1": attribute("extra", 1),
    r"object 1 \(IDMVehicle\) hit: stock False, accelerated 0": attribute("hit", 0),
    r"object 0 \(MDPVehicle\) target_lane_index: stock \(.*\), accelerated \[.*\]": attribute(
        "target_lane_index", ["a", "b", 1], number=0
    ),
    r"COMFORT_ACC_MIN of object 3: stock -5.0, accelerated -5.1": attribute(
        "COMFORT_ACC_MIN", -5.1, number=3
    ),
    r"object 5 \(Obstacle\) crashed: stock False": lambda env, _: vars(env.road.objects[0]).update(
        crashed=True
    ),
    r"generator state state: stock \d+": lambda env, _: env.np_random.uniform(),
    r"steps: stock 45": lambda env, _: vars(env).update(steps=46),
    r"object 4 \(IDMVehicle\): stock \{": lambda env, _: env.road.vehicles.pop(),
    r"reward: stock 0\.\d+, accelerated 0.5": result(1, 0.5),
    r"info rewards .*": lambda env, returned: returned[4]["rewards"].popitem(),
    r"observation: .*": lambda env, returned: returned[0].__setitem__((2, 3), 0.25),
}


@pytest.mark.parametrize("message", FAULTS)
def test_a_fault_is_reported(message):
    expected = rf"seed 5, step 2: \d+ differences\n(.*\n)*  {message}"
    with pytest.raises(AssertionError, match=expected):
        lockstep(MERGE, lambda: Faulty(FAULTS[message]), seeds=[5], steps=4, compiled=None)


def test_no_fault_no_report():
    lockstep(MERGE, lambda: Faulty(lambda env, returned: None), seeds=[5], steps=4, compiled=None)


def test_a_different_number_of_steps_is_reported():
    with pytest.raises(AssertionError, match=r"step 2: .*\n(.*\n)*  terminated: stock False"):
        lockstep(MERGE, lambda: Faulty(result(2, True)), seeds=[5], steps=9, compiled=None)


def test_stock_code_where_compiled_was_expected_is_reported():
    with pytest.raises(AssertionError):
        lockstep(MERGE, MERGE, steps=2)


def test_classes_are_left_alone():
    before = dict(vars(IDMVehicle))
    lockstep(partial(gym.make, "intersection-v0"), steps=1, compiled=None)
    assert dict(vars(IDMVehicle)) == before


@pytest.mark.parametrize(
    ("a", "b", "same"),
    [
        (1, 1.0, True),
        (1, True, False),
        (0.0, -0.0, False),
        (float("nan"), float("nan"), True),
        (1.0, np.nextafter(1.0, 2).item(), False),
        (2**127, 2**127 + 1, False),
        (None, 0, False),
        ("a", "a", True),
        (np.zeros(2), np.zeros(2), True),
        (np.zeros(2), -np.zeros(2), False),
        (np.zeros(2), np.zeros(2, np.float32), False),
        (np.zeros(2), np.zeros((2, 1)), False),
        (np.zeros(1), 0.0, False),
    ],
)
def test_equality_of_values(a, b, same):
    assert equal(a, b) == equal(b, a) == same
