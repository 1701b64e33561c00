"""lane-keeping-v0 (``envs/lane_keeping_env.py``), which observes before it simulates."""

from __future__ import annotations

from typing import Any

from highway_env.envs.lane_keeping_env import LaneKeepingEnv
from highway_env.vehicle.dynamics import BicycleVehicle

from esc_gym.fastsim.cache import cached
from esc_gym.fastsim.geometry import VEHICLE_LENGTH, local_coordinates, width_at
from esc_gym.fastsim.kernel import EGO, scene_of
from esc_gym.fastsim.known import Repeated
from esc_gym.fastsim.numerics import libm, outlined
from esc_gym.vector.kernel import beginning, judging
from esc_gym.vector.scenes.roads import create
from esc_gym.vector.state import RUNNING

CLASSES = (LaneKeepingEnv,)
REWARDS: dict[str, type] = {}
SILENT = True  # its steps say nothing in ``info``
REPEATED = Repeated(
    "85097c3d527e93575ef2508f9bf47876f6b5dcb4b63d97a9f64e94c922b7a9e7",
    (LaneKeepingEnv, "step _reward _is_terminated _is_truncated _reset _make_road _make_vehicles"),
    (LaneKeepingEnv, "store_data"),
)
# The constants: where the ego begins, and the two lanes that it is to keep.
X, Y, HEADING, FIRST, SECOND = range(5)


def unknown(env: Any) -> str:
    """Why the engine cannot do this configuration; "" if it can."""
    if not isinstance(env.vehicle, BicycleVehicle):
        return "a vehicle without dynamics, at which highway-env fails"
    return "a linear parameter-varying system beside the vehicle" if env.lpv else ""


def lane(env: Any, network: Any) -> int:
    """The lane of the ego features ``ref_lat_off``, ``ref_cos`` and ``ref_sin``, at first."""
    return network.numbers["c", "d", 0]


def constants(env: Any, network: Any) -> list[float]:
    """The configuration as numbers."""
    start = env.road.network.get_lane(("c", "d", 0))
    return [
        *start.position(50, -4), start.heading_at(0),
        network.numbers["c", "d", 0], network.numbers["a", "b", 0],
    ]  # fmt: skip


@outlined
def reset(s, ego, g, c, ranges, plans, lengths, template):
    """``LaneKeepingEnv._make_vehicles``; how many vehicles there are."""
    create(s, ego, c[X], c[Y], c[HEADING], 8.3)
    return 1


@outlined
def judge(s, ego, head, action, c, parts):
    """``LaneKeepingEnv._reward``; its time stands still, and it does not end."""
    if action == -1.0:
        head.lane = int(c[FIRST])
    me = s.vehicles[ego]
    head.time = 0.0
    lateral = local_coordinates(s, head.lane, me.x, me.y)[1]
    return 1 - libm(s.np.libm_pow, lateral / s.lanes[head.lane].width, 2.0), False, False


@cached
def prepare_all(
    vehicles, counts, routes, lanes, lon, lat, seats, ranks, ranked, link_start, link_lane,
    link_offset, exits, poses, widths, samples, numerics, heads, constants, first, last
):  # fmt: skip
    """What ``LaneKeepingEnv.step`` begins with: at the end of a lane, go on with the next."""
    for e in range(first, last):
        if heads[e].over == RUNNING and heads[e].lane == int(constants[FIRST]):
            s = scene_of(
                e, vehicles, counts, routes, lanes, lon, lat, seats, ranks, ranked, link_start,
                link_lane, link_offset, exits, poses, widths, samples, numerics,
            )  # fmt: skip
            me, k = s.vehicles[counts[e, EGO]], heads[e].lane
            along, lateral = local_coordinates(s, k, me.x, me.y)
            if not (
                abs(lateral) <= width_at(s, k, along) / 2 + 0
                and -VEHICLE_LENGTH <= along < s.lanes[k].length + VEHICLE_LENGTH
            ):
                heads[e].lane = int(constants[SECOND])


judge_all, begin_all = judging(judge), beginning(reset, judge)
