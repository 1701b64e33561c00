"""What the compiled simulation works on: one record per vehicle and object, one per lane.

n vehicles, then the objects, m in all; L lanes. Every field is 8 bytes wide, so that ``struct`` can
fill and read a record in one call. Units are highway-env's: m, s, rad.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

# Kinds of vehicles and objects, by the code that drives them.
PLAIN, BICYCLE, CONTROLLED, MDP, IDM, LINEAR, OBSTACLE, LANDMARK = range(8)
# Kinds of lanes.
STRAIGHT, SINE, CIRCULAR, SPLINE = range(4)

# What a simulation can change about a vehicle, read and written at every policy step.
STATE_FLOATS = (
    "x", "y", "heading", "speed", "steering", "acceleration", "timer",
    "target_speed", "impact_x", "impact_y", "lateral_speed", "yaw_rate",
)  # fmt: skip
STATE_INTS = (
    "lane", "target_lane", "crashed", "has_impact", "hit", "yielding", "yield_timer",
    "route_length", "route_taken", "changed",
)  # fmt: skip
# What the driver and the body are like; rewritten only when it is found changed.
TRAIT_FLOATS = (
    "length", "width", "diagonal", "max_speed", "min_speed",
    "kp_acceleration", "kp_heading", "kp_lateral", "tau_pursuit", "max_steering",
    "acc_max", "comfort_max", "comfort_min", "distance_wanted", "time_wanted", "delta",
    "politeness", "min_gain", "max_braking", "lane_change_delay",
    "acceleration_0", "acceleration_1", "acceleration_2", "steering_0", "steering_1",
    "mass", "length_a", "length_b", "inertia", "friction_front", "friction_rear", "max_yaw_rate",
)  # fmt: skip
TRAIT_INTS = (
    "kind", "solid", "collidable", "checks_collisions", "changes_lanes", "collects", "coasts",
)  # fmt: skip
DERIVED = ("cos", "sin")

# States and parameters beyond this are left to stock code: no product of those below is infinite.
LARGEST, LARGEST_DELTA = 1e9, 20.0

# In routes: a road that is not in the network, and a lane that the route leaves open.
NO_ROAD, NO_LANE = -1, -(1 << 40)

# Bits of ``changed``: what has to be written back beyond position, heading, speed and action.
LANE_CHANGED, TARGET_CHANGED, CRASH, IMPACT, HIT, YIELD, COMMANDED = (1 << bit for bit in range(7))

# What a meta-action may ask of the ego's lane; NOTHING: there is no meta-action to carry out.
NOTHING, KEEP, LEFT, RIGHT = range(4)

VEHICLE = np.dtype(
    [(name, "f8") for name in STATE_FLOATS]
    + [(name, "i8") for name in STATE_INTS]
    + [(name, "f8") for name in TRAIT_FLOATS]
    + [(name, "i8") for name in TRAIT_INTS]
    + [(name, "f8") for name in DERIVED]
)
STATE = struct.Struct(f"={len(STATE_FLOATS)}d{len(STATE_INTS)}q")
# x to timer, route_taken and changed: what every vehicle needs back after a step.
MOVED = struct.Struct(f"=7d{8 * (len(STATE_FLOATS) - 7 + len(STATE_INTS) - 2)}x2q")
TRAITS = struct.Struct(f"={len(TRAIT_FLOATS)}d{len(TRAIT_INTS)}q")

LANE_FLOATS = (
    "start_x", "start_y", "direction_x", "direction_y", "lateral_x", "lateral_y", "heading",
    "amplitude", "pulsation", "phase", "center_x", "center_y", "radius", "start_phase", "turn",
    "length", "width", "speed_limit", "priority",
)  # fmt: skip
LANE_INTS = (
    "kind", "forbidden", "limited", "id", "road", "count", "exits", "exits_count",
    "poses", "poses_count", "widths", "widths_count",
)  # fmt: skip
LANE = np.dtype([(name, "f8") for name in LANE_FLOATS] + [(name, "i8") for name in LANE_INTS])

# One sampled point of a LinearSpline2D, and the heading of the lane after it.
POSE_COLUMNS = ("s", "x", "y", "normal_x", "normal_y", "orthonormal_x", "orthonormal_y", "heading")
# What LinearVehicle.collect_data stores at every sub-step, after the number of the vehicle.
SAMPLE_COLUMNS = 8


class Numerics(NamedTuple):
    """How this machine's NumPy computes: its inner loops, and the rounding of its products.

    ``<function>``, ``<function>_data``: address of NumPy's loop and of its data, as integers.
    multiplies: whether it squares by a product. dot, matrix_vector, matrix_matrix: how
    a0*b0 + a1*b1 is rounded there (see numerics.py).
    """

    sin: int
    sin_data: int
    cos: int
    cos_data: int
    tan: int
    tan_data: int
    arcsin: int
    arcsin_data: int
    arctan: int
    arctan_data: int
    arctan2: int
    arctan2_data: int
    power: int
    power_data: int
    libm_pow: int
    libm_sin: int
    libm_cos: int
    multiplies: int
    dot: int
    matrix_vector: int
    matrix_matrix: int


class Scene(NamedTuple):
    """Everything that the kernels read and write.

    vehicles: VEHICLE [m + 1]; the last one is scratch. lanes: LANE [L].
    lon, lat: [L, m] coordinates of everyone on every lane; lon is NaN where nobody asked for it
    yet. seats [L, m]: lon of those who stand on the lane and can be somebody's neighbour, else NaN.
    ranks [L, m], ranked [L]: who has a seat on a lane, from behind to ahead, and how many they are;
    -1 where nobody asked for it yet.
    link_start [L + 1], link_lane, link_offset: the lanes searched for neighbours of a lane, itself
    first. exits: first lanes of the roads that start where a lane ends, all lanes' together.
    poses [P, 8], widths [W]: splines of all lanes. routes [m, R, 2]: first lane of a road or
    NO_ROAD, number of the lane there or NO_LANE. samples [S, 8]: see SAMPLE_COLUMNS.
    """

    vehicles: np.ndarray
    lanes: np.ndarray
    lon: np.ndarray
    lat: np.ndarray
    seats: np.ndarray
    ranks: np.ndarray
    ranked: np.ndarray
    link_start: np.ndarray
    link_lane: np.ndarray
    link_offset: np.ndarray
    exits: np.ndarray
    poses: np.ndarray
    widths: np.ndarray
    routes: np.ndarray
    samples: np.ndarray
    n: int
    m: int
    np: Numerics
