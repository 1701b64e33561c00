"""An independent reading of highway-env's road, for comparison with the observation."""

from __future__ import annotations

import math

import numpy as np
from highway_env.vehicle.objects import Landmark, Obstacle


def expected_set(env, distance, frame):
    """Rows (x, y, vx, vy, cos_h, sin_h, obstacle) by the textbook formulas, in road order."""
    ego, road = env.unwrapped.vehicle, env.unwrapped.road
    angle = ego.heading if frame == "ego" else 0.0
    rotation = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    rows = []
    for other in [*road.vehicles, *road.objects]:
        offset = other.position - ego.position
        if other is ego or isinstance(other, Landmark) or np.hypot(*offset) >= distance:
            continue
        velocity = np.zeros(2) if isinstance(other, Obstacle) else other.velocity
        heading = [math.cos(other.heading), math.sin(other.heading)]
        motion = [*(rotation @ (velocity - ego.velocity)), *(rotation @ heading)]
        rows.append([*(rotation @ offset), *motion, float(isinstance(other, Obstacle))])
    return np.array(rows).reshape(-1, 7)


def assert_same_set(rows, expected, atol=1e-3):
    """Equal as multisets: each row finds an expected row that no other row has taken."""
    assert len(rows) == len(expected)
    left = list(expected)
    for row in rows:
        errors = [np.abs(row - other).max() for other in left]
        best = int(np.argmin(errors))
        assert errors[best] < atol, (row, left)
        del left[best]


def observe(env):
    """What a wrapped environment observes now."""
    return env.unwrapped.observation_type.observe()
