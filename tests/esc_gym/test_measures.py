"""Scenes made by hand; cars are 5 m by 2 m, positions in m, speeds in m/s."""

from math import cos, inf, pi, sin
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from esc_gym.measures import time_to_collision


def car(x, y, speed=0.0, heading=0.0, solid=True):
    velocity = speed * np.array([cos(heading), sin(heading)])
    return SimpleNamespace(
        position=np.array([x, y]), velocity=velocity, heading=heading, solid=solid,
        LENGTH=5.0, WIDTH=2.0,
    )  # fmt: skip


def ttc(ego, *others):
    road = SimpleNamespace(vehicles=[ego, *others], objects=[])
    return time_to_collision(SimpleNamespace(vehicle=ego, road=road))


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        (car(45, 0, speed=10), (45 - 5) / (30 - 10)),  # following: gap over closing speed
        (car(65, 0, speed=30, heading=pi), (65 - 5) / (30 + 30)),  # head-on
        (car(45, 4, speed=10), inf),  # next lane
        (car(45, 1.9, speed=10), (45 - 5) / (30 - 10)),  # next lane, but 0.1 m over the line
        (car(45, 0, speed=40), inf),  # drives away
        (car(-45, 0, speed=40), (45 - 5) / (40 - 30)),  # comes from behind
        (car(45, 0, speed=30), inf),  # same speed
        (car(3, 1, speed=0), 0.0),  # already touching
        (car(30, 0, solid=False), inf),  # a landmark
    ],
)
def test_scenes_on_a_straight_road(other, expected):
    assert ttc(car(0, 0, speed=30), other) == pytest.approx(expected)


def test_crossing():
    ego = car(0, 0, speed=10)
    # It enters the ego's strip (|y| < 1 + 2.5) at t = 1.65 s and is in the ego's way (|x| < 3.5)
    # from t = 1.65 s on, when 20 m - 16.5 m are left.
    crossing = car(20, -20, speed=10, heading=pi / 2)
    assert ttc(ego, crossing) == pytest.approx(1.65)
    late = car(20, -80, speed=10, heading=pi / 2)  # enters at 7.65 s, the ego passes by 2.35 s
    assert ttc(ego, late) == inf


def test_turning_the_whole_scene_changes_nothing():
    for angle in (0.3, pi / 2, 2.5):
        x, y = 65 * cos(angle), 65 * sin(angle)
        ego, other = car(0, 0, 30, heading=angle), car(x, y, 30, heading=angle + pi)
        assert ttc(ego, other) == pytest.approx(1.0)


def test_nearest_in_time_counts_and_nobody_is_infinite():
    ego = car(0, 0, speed=20)
    assert ttc(ego, car(205, 0), car(45, 0), car(-45, 0)) == pytest.approx(40 / 20)
    assert ttc(ego) == inf


def test_obstacles_of_the_road_count():
    ego, obstacle = car(0, 0, speed=10), car(25, 0)
    road = SimpleNamespace(vehicles=[ego], objects=[obstacle])
    assert time_to_collision(SimpleNamespace(vehicle=ego, road=road)) == pytest.approx(2.0)


@settings(max_examples=50, deadline=None)
@given(st.floats(-60, 60), st.floats(-6, 6), st.floats(-30, 30), st.floats(-3, 3))
def test_agrees_with_driving_on_and_looking(x, y, vx, vy):
    other = car(x, y)
    other.velocity = np.array([vx, vy])
    times = np.arange(0, 5, 1e-3)
    touch = (np.abs(x + vx * times) <= 5) & (np.abs(y + vy * times) <= 2)
    found = ttc(car(0, 0), other)
    if touch.any():
        assert found == pytest.approx(times[touch.argmax()], abs=1.1e-3)
    else:
        # Looking once a millisecond can miss a touch that is shorter: is it one?
        closest = abs(x + vx * found) - 5, abs(y + vy * found) - 2
        assert found > 5 - 1e-3 or max(closest) < 1e-6
