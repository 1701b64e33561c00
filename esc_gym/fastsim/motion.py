"""How vehicles move: the kinematic and the dynamic bicycle (``kinematics.py``, ``dynamics.py``)."""

from __future__ import annotations

import numpy as np

from esc_gym.fastsim.geometry import closest_lane, locate
from esc_gym.fastsim.numerics import (
    arctan,
    arctan2,
    clip,
    compiled,
    cos,
    dot,
    merged,
    outlined,
    sin,
    tan,
)
from esc_gym.fastsim.records import BICYCLE, CRASH, IDM, IMPACT, LANE_CHANGED


@compiled
def clip_actions(vehicle):
    """``Vehicle.clip_actions``: the crashed brake, the too fast slow down."""
    if vehicle.crashed:
        vehicle.steering = 0.0
        vehicle.acceleration = -1.0 * vehicle.speed
    if vehicle.speed > vehicle.max_speed:
        limit = 1.0 * (vehicle.max_speed - vehicle.speed)
        vehicle.acceleration = min(vehicle.acceleration, limit)
    elif vehicle.speed < vehicle.min_speed:
        limit = 1.0 * (vehicle.min_speed - vehicle.speed)
        vehicle.acceleration = max(vehicle.acceleration, limit)


@compiled
def move_kinematic(s, i, dt):
    """``Vehicle.step`` but for the lane."""
    vehicle = s.vehicles[i]
    clip_actions(vehicle)
    slip = 1 / 2 * tan(s.np, vehicle.steering)
    slip = arctan(s.np, slip)
    course = vehicle.heading + slip
    vehicle.x += vehicle.speed * cos(s.np, course) * dt
    vehicle.y += vehicle.speed * sin(s.np, course) * dt
    if vehicle.has_impact:
        vehicle.x += vehicle.impact_x
        vehicle.y += vehicle.impact_y
        vehicle.crashed, vehicle.has_impact = 1, 0
        vehicle.changed |= CRASH | IMPACT
    turn = sin(s.np, slip)
    vehicle.heading += vehicle.speed * turn / (vehicle.length / 2) * dt
    vehicle.speed += vehicle.acceleration * dt


@compiled
def bicycle_derivative(s, i, heading, speed, lateral_speed, yaw_rate):
    """``BicycleVehicle.derivative_func``: what is not constant of it (x, y, lateral, yaw)."""
    v = s.vehicles[i]
    front = lateral_speed + v.length_a * yaw_rate
    front = arctan2(s.np, front, speed)
    rear = lateral_speed - v.length_b * yaw_rate
    rear = arctan2(s.np, rear, speed)
    force_front = 2 * v.friction_front * (v.steering - front)
    force_rear = 2 * v.friction_rear * (0 - rear)
    if abs(speed) < 1:
        force_front = -v.mass * lateral_speed - v.inertia / v.length_a * yaw_rate
        force_rear = -v.mass * lateral_speed + v.inertia / v.length_a * yaw_rate
    lateral = 1 / v.mass * (force_front + force_rear) - yaw_rate * speed
    yaw = 1 / v.inertia * (v.length_a * force_front - v.length_b * force_rear)
    c = cos(s.np, heading)
    n = sin(s.np, heading)
    x = dot(s.np.matrix_vector, c, -n, speed, lateral_speed)
    y = dot(s.np.matrix_vector, n, c, speed, lateral_speed)
    return np.array([x, y, yaw_rate, v.acceleration, lateral, yaw])


@outlined
def move_dynamic(s, i, dt):
    """``BicycleVehicle.step`` (fourth-order Runge-Kutta) but for the lane; ignores impacts."""
    v = s.vehicles[i]
    clip_actions(v)
    v.steering = clip(v.steering, -np.pi / 2, np.pi / 2)
    v.yaw_rate = clip(v.yaw_rate, -v.max_yaw_rate, v.max_yaw_rate)
    state = np.array([v.x, v.y, v.heading, v.speed, v.lateral_speed, v.yaw_rate])
    f1 = bicycle_derivative(s, i, state[2], state[3], state[4], state[5])
    at = state + f1 * (dt / 2)
    f2 = bicycle_derivative(s, i, at[2], at[3], at[4], at[5])
    at = state + f2 * (dt / 2)
    f3 = bicycle_derivative(s, i, at[2], at[3], at[4], at[5])
    at = state + f3 * dt
    f4 = bicycle_derivative(s, i, at[2], at[3], at[4], at[5])
    state = state + (dt / 6) * (f1 + (2 * f2) + (2 * f3) + f4)
    v.x, v.y, v.heading, v.speed, v.lateral_speed, v.yaw_rate = (
        state[0], state[1], state[2], state[3], state[4], state[5]
    )  # fmt: skip


@compiled
def move(s, i, dt):
    """The vehicle's ``step`` but for the lane."""
    if s.vehicles[i].kind == BICYCLE:
        move_dynamic(s, i, dt)
    else:
        move_kinematic(s, i, dt)


@merged
def step(s, i, dt):
    """``vehicle.step(dt)``."""
    vehicle = s.vehicles[i]
    if vehicle.kind >= IDM:
        vehicle.timer += dt
    move(s, i, dt)
    locate(s, i)
    lane = closest_lane(s, i)
    if lane != vehicle.lane:
        vehicle.lane = lane
        vehicle.changed |= LANE_CHANGED
