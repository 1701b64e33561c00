"""What drivers decide: IDM, MOBIL, linear drivers, steering (``vehicle/behavior.py``).

``me`` is the driver whose parameters count; it also reasons about ``ego``, another vehicle, and
``front``, the one before that. -1 stands for nobody.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from esc_gym.fastsim.geometry import along, heading_at, is_reachable
from esc_gym.fastsim.neighbours import NOBODY, neighbours
from esc_gym.fastsim.numerics import (
    arcsin,
    arctan,
    clip,
    compiled,
    dot,
    dot3,
    libm,
    merged,
    not_zero,
    outlined,
    power,
    square,
    tan,
    wrap_to_pi,
)
from esc_gym.fastsim.records import (
    BICYCLE,
    COMMANDED,
    CONTROLLED,
    IDM,
    KEEP,
    LINEAR,
    NO_LANE,
    PLAIN,
    RIGHT,
    TARGET_CHANGED,
)


@compiled
def lane_distance(s, ego, other):
    """``RoadObject.lane_distance_to`` along the lane of ``ego``."""
    lane = s.vehicles[ego].lane
    return along(s, lane, other) - along(s, lane, ego)


@compiled
def desired_gap(s, me, ego, front):
    """``IDMVehicle.desired_gap``."""
    driver, back, lead = s.vehicles[me], s.vehicles[ego], s.vehicles[front]
    dvx = back.speed * back.cos - lead.speed * lead.cos
    dvy = back.speed * back.sin - lead.speed * lead.sin
    closing = dot(s.np.dot, dvx, dvy, back.cos, back.sin)
    scale = 2 * sqrt(-driver.comfort_max * driver.comfort_min)
    return driver.distance_wanted + back.speed * driver.time_wanted + back.speed * closing / scale


@compiled
def free_acceleration(s, me, ego):
    """What ``IDMVehicle.acceleration`` starts from: nobody is in front. 0 for linear drivers."""
    if ego == NOBODY or ego >= s.n or s.vehicles[me].kind == LINEAR:
        return 0.0
    driver, vehicle = s.vehicles[me], s.vehicles[ego]
    target = vehicle.target_speed if vehicle.kind >= CONTROLLED else 0.0
    lane = s.lanes[vehicle.lane]
    if lane.limited:
        target = clip(target, 0.0, lane.speed_limit)
    ratio = max(vehicle.speed, 0.0) / abs(not_zero(target))
    return driver.comfort_max * (1 - power(s.np, ratio, driver.delta))


@compiled
def idm_acceleration(s, me, ego, front, free):
    """``IDMVehicle.acceleration``."""
    if front == NOBODY or ego == NOBODY or ego >= s.n:
        return free
    gap = desired_gap(s, me, ego, front) / not_zero(lane_distance(s, ego, front))
    return free - s.vehicles[me].comfort_max * square(s.np, gap)


@compiled
def linear_features(s, me, ego, front):
    """``LinearVehicle.acceleration_features``."""
    if ego == NOBODY:
        return 0.0, 0.0, 0.0
    driver, vehicle = s.vehicles[me], s.vehicles[ego]
    targeted = ego < s.n and vehicle.kind >= CONTROLLED
    faster = vehicle.target_speed - vehicle.speed if targeted else 0.0
    if front == NOBODY:
        return faster, 0.0, 0.0
    safe = driver.distance_wanted + max(vehicle.speed, 0.0) * driver.time_wanted
    slower = min(s.vehicles[front].speed - vehicle.speed, 0.0)
    return faster, slower, min(lane_distance(s, ego, front) - safe, 0.0)


@compiled
def linear_acceleration(s, me, ego, front):
    """``LinearVehicle.acceleration``."""
    driver = s.vehicles[me]
    f0, f1, f2 = linear_features(s, me, ego, front)
    p0, p1, p2 = driver.acceleration_0, driver.acceleration_1, driver.acceleration_2
    return dot3(s.np.dot, p0, p1, p2, f0, f1, f2)


@compiled
def acceleration(s, me, ego, front, free):
    """The acceleration of ``ego`` behind ``front`` in the eyes of ``me``.

    free: ``free_acceleration(s, me, ego)``, the same for everybody who may be in front.
    """
    if s.vehicles[me].kind == LINEAR:
        return linear_acceleration(s, me, ego, front)
    return idm_acceleration(s, me, ego, front, free)


@compiled
def sign(x):
    return (x > 0) - (x < 0)


@outlined
def mobil(s, i, k, old_front, old_rear, free, mine_before):
    """``IDMVehicle.mobil``: is changing to lane ``k`` safe and worth it?

    old_front, old_rear: neighbours on the present lane; free, mine_before: ``free_acceleration``
    and ``acceleration`` there.
    """
    driver = s.vehicles[i]
    new_front, new_rear = neighbours(s, i, k)
    new_rear_free = free_acceleration(s, i, new_rear)
    new_rear_after = acceleration(s, i, new_rear, i, new_rear_free)
    if new_rear_after < -driver.max_braking:
        return False
    mine_after = acceleration(s, i, i, new_front, free)
    planned = s.routes[i, driver.route_taken, 1] if driver.route_length > 0 else NO_LANE
    if planned != NO_LANE:
        target = s.lanes[driver.target_lane].id
        if sign(s.lanes[k].id - target) != sign(planned - target):
            return False
        return not mine_after < -driver.max_braking
    others = 0.0
    if driver.politeness != 0.0:  # nobody else counts then, and adding zero changes nothing
        new_rear_before = acceleration(s, i, new_rear, new_front, new_rear_free)
        old_rear_free = free_acceleration(s, i, old_rear)
        old_rear_before = acceleration(s, i, old_rear, i, old_rear_free)
        old_rear_after = acceleration(s, i, old_rear, old_front, old_rear_free)
        others = new_rear_after - new_rear_before + old_rear_after - old_rear_before
    return not mine_after - mine_before + driver.politeness * others < driver.min_gain


@compiled
def set_target(driver, k):
    driver.target_lane = k
    driver.changed |= TARGET_CHANGED


@outlined
def change_lane(s, i, command):
    """The lane change of ``ControlledVehicle.act``, if the lane can be reached."""
    driver = s.vehicles[i]
    if command == KEEP:
        return
    lane = s.lanes[driver.target_lane]
    number = lane.id + (1 if command == RIGHT else -1)
    k = lane.road + min(max(number, 0), lane.count - 1)
    if is_reachable(s, k, i):
        set_target(driver, k)
        driver.changed |= COMMANDED


@outlined
def give_way(s, i):
    """An ongoing lane change is called off if someone in front is changing to the same lane."""
    driver = s.vehicles[i]
    if s.lanes[driver.lane].road != s.lanes[driver.target_lane].road:
        return
    for j in range(s.n):
        other = s.vehicles[j]
        same = other.kind >= CONTROLLED and other.target_lane == driver.target_lane
        if j == i or not same or other.lane == driver.target_lane:
            continue
        ahead = lane_distance(s, i, j)
        if ahead > 0 and ahead < desired_gap(s, i, i, j):
            set_target(driver, driver.lane)
            return


@merged
def change_lane_policy(s, i, front, rear, free, command):
    """``IDMVehicle.change_lane_policy``; the rest as of ``mobil``, on the present lane."""
    driver = s.vehicles[i]
    if driver.lane != driver.target_lane:
        give_way(s, i)
        return
    if not driver.lane_change_delay < driver.timer:
        return
    driver.timer = 0.0
    lane = driver.lane
    for side in (-1, 1):
        other = s.lanes[lane].id + side
        if other < 0 or other >= s.lanes[lane].count:
            continue
        k = lane + side
        reachable = is_reachable(s, k, i) and abs(driver.speed) >= 1
        if reachable and mobil(s, i, k, front, rear, free, command):
            set_target(driver, k)


@compiled
def pursuit_steering(s, i):
    """``ControlledVehicle.steering_control`` towards the target lane."""
    driver = s.vehicles[i]
    k = driver.target_lane
    speed = not_zero(driver.speed)
    ahead = heading_at(s, k, along(s, k, i) + driver.speed * driver.tau_pursuit)
    command = clip(-driver.kp_lateral * s.lat[k, i] / speed, -1.0, 1.0)
    command = arcsin(s.np, command)
    reference = ahead + clip(command, -np.pi / 4, np.pi / 4)
    rate = driver.kp_heading * wrap_to_pi(reference - driver.heading)
    slip = clip(driver.length / 2 / speed * rate, -1.0, 1.0)
    slip = arcsin(s.np, slip)
    steering = 2 * tan(s.np, slip)
    steering = arctan(s.np, steering)
    return clip(steering, -driver.max_steering, driver.max_steering)


@compiled
def steering_features(s, i):
    """``LinearVehicle.steering_features`` towards the target lane."""
    driver = s.vehicles[i]
    k = driver.target_lane
    speed = not_zero(driver.speed)
    ahead = heading_at(s, k, along(s, k, i) + driver.speed * driver.tau_pursuit)
    turn = wrap_to_pi(ahead - driver.heading) * driver.length / speed
    return turn, -s.lat[k, i] * driver.length / libm(s.np.libm_pow, speed, 2.0)


@compiled
def linear_steering(s, i):
    """``LinearVehicle.steering_control``, clipped as ``IDMVehicle.act`` does."""
    driver = s.vehicles[i]
    f0, f1 = steering_features(s, i)
    steering = dot(s.np.dot, driver.steering_0, driver.steering_1, f0, f1)
    return clip(steering, -driver.max_steering, driver.max_steering)


@outlined
def collect(s, i, sample):
    """``LinearVehicle.collect_data``."""
    driver = s.vehicles[i]
    front, _ = neighbours(s, i, driver.lane)
    f0, f1, f2 = linear_features(s, i, i, front)
    p0, p1, p2 = driver.acceleration_0, driver.acceleration_1, driver.acceleration_2
    g0, g1 = steering_features(s, i)
    row = s.samples[sample]
    row[0], row[1], row[2], row[3] = i, f0, f1, f2
    row[4] = dot3(s.np.dot, p0, p1, p2, f0, f1, f2)
    row[5], row[6] = g0, g1
    row[7] = dot(s.np.dot, driver.steering_0, driver.steering_1, g0, g1)


@merged
def drive_idm(s, i):
    """``IDMVehicle.act`` after following the road; also of linear drivers.

    What a driver sees on the present lane is looked up once: nothing that is decided changes it.
    """
    driver = s.vehicles[i]
    front, rear = neighbours(s, i, driver.lane)
    free = free_acceleration(s, i, i)
    command = acceleration(s, i, i, front, free)
    if driver.changes_lanes:
        change_lane_policy(s, i, front, rear, free, command)
    driver.steering = linear_steering(s, i) if driver.kind == LINEAR else pursuit_steering(s, i)
    if driver.lane != driver.target_lane:
        front, _ = neighbours(s, i, driver.target_lane)
        command = min(command, acceleration(s, i, i, front, free))
    driver.acceleration = clip(command, -driver.acc_max, driver.acc_max)


@merged
def acts(driver):
    """Does ``act()`` without an action do anything?"""
    if driver.kind == PLAIN or driver.kind == BICYCLE:
        return False
    return driver.kind < IDM or not driver.crashed


@merged
def drive(s, i):
    """``vehicle.act()`` after following the road."""
    driver = s.vehicles[i]
    if driver.kind >= IDM:
        drive_idm(s, i)
    else:
        driver.steering = pursuit_steering(s, i)
        driver.acceleration = driver.kp_acceleration * (driver.target_speed - driver.speed)
