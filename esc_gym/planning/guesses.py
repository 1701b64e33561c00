"""What a driver cannot see, guessed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from numpy.typing import NDArray

from esc_gym.fastsim.behavior import PARAMETERS, original_behavior
from esc_gym.fastsim.kernel import EGO, ITEMS, VEHICLES
from esc_gym.fastsim.records import CONTROLLED, IDM, LINEAR, NO_LANE
from esc_gym.fastsim.traits import TRAITS_OF
from esc_gym.vector.environment import SetVectorEnv
from esc_gym.vector.generators import row
from esc_gym.vector.state import ROAD, State

# What a driver wants who is held up, as a share of the limit: drivers that highway-env makes at
# random want 0.7 to 0.8 of it (Vehicle.create_random).
WISH = 0.75
_ATTRIBUTES = {
    trait: attribute
    for trait, attribute in TRAITS_OF[IDM].items()
    if attribute.isupper() and trait not in TRAITS_OF[CONTROLLED]
}
with original_behavior(IDMVehicle):
    NOMINAL = {trait: getattr(IDMVehicle, name) for trait, name in _ATTRIBUTES.items()}
"""Traits of a driver of whom nothing is known, by the names of ``fastsim.records``."""


def entropy(envs: SetVectorEnv, e: int, seed: int, *more: int) -> list[int]:
    """Of a generator whose numbers depend on ``seed``, the environment's own seed and time, and
    nothing else."""
    head = envs.engine.state.heads[e]
    return [seed, *more, int(head["seed"]) + 1, int(head["elapsed"])]


def guess(
    envs: SetVectorEnv, indices: Sequence[int] | NDArray, futures: int, seed: int
) -> SetVectorEnv:
    """Copies of environments in which everything is a guess that their egos cannot see.

    There are ``futures`` copies of each of ``indices``, one beside the other.

    Seen are the road, and position, heading, speed, size and lane of everyone within the perception
    distance; the others are not there. Drivers are IDM and MOBIL's as the scenario has them, are on
    their way to no other lane yet, and want to go as fast as they do, or if they are held up as
    fast as drivers mostly want. Where they turn off, when they next think of changing lanes, and
    who comes next is drawn at random, for each copy anew.
    """
    copies = envs.fork(np.repeat(indices, futures).tolist())
    state, network, nominals = copies.engine.state, copies.engine.network, nominal(envs)
    for e in range(len(state.heads)):
        generator = np.random.default_rng(entropy(copies, e, seed, e % futures))
        _leave_out(state, e, envs.set_spec.perception_distance)
        _guess_drivers(state, e, network, nominals, generator)
        state.generators[e, ROAD] = row(generator)
    return copies


def _leave_out(state: State, e: int, distance: float) -> None:
    """Take away the vehicles that the ego of environment ``e`` cannot see."""
    count, items, _, ego = state.counts[e]
    vehicles = state.vehicles[e]
    me = vehicles[ego]
    seen = np.hypot(vehicles["x"][:count] - me["x"], vehicles["y"][:count] - me["y"]) <= distance
    kept = np.flatnonzero(np.append(seen, np.ones(items - count, bool)))
    for array in (vehicles, state.routes[e], state.ids[e]):
        array[: len(kept)] = array[kept]
    state.counts[e, [VEHICLES, ITEMS, EGO]] = seen.sum(), len(kept), seen[:ego].sum()


def _guess_drivers(
    state: State, e: int, network: Any, nominals: dict[str, float], generator: np.random.Generator
) -> None:
    """What those who are left in environment ``e`` want, and how they drive."""
    count, _, _, ego = state.counts[e]
    vehicles, lanes = state.vehicles[e], network.records
    kinds = vehicles["kind"][:count]
    others = np.flatnonzero(((kinds == IDM) | (kinds == LINEAR)) & (np.arange(count) != ego))
    theirs = vehicles[others]
    theirs["kind"], theirs["target_lane"] = IDM, theirs["lane"]
    own = lanes[theirs["lane"]]
    wished = np.where(own["limited"], WISH * own["speed_limit"], 0.0)
    theirs["target_speed"] = np.maximum(theirs["speed"], wished)
    for name, value in nominals.items():
        theirs[name] = value
    theirs["timer"] = generator.uniform(0.0, IDMVehicle.LANE_CHANGE_DELAY, len(theirs))
    theirs["yielding"] = theirs["yield_timer"] = 0
    routes, theirs["route_length"] = _guess_routes(
        own["road"], state.routes.shape[2], network, generator
    )
    theirs["route_taken"] = 0
    state.routes[e, others] = routes
    vehicles[others] = theirs


def _guess_routes(
    road: NDArray, length: int, network: Any, generator: np.random.Generator
) -> tuple[NDArray, NDArray]:
    """Ways on from roads [K], at each end by one of those that start there.

    Returns routes [K, length, 2], as in ``fastsim.records.Scene``, and how long each is [K].
    """
    lanes, after = network.records, np.append(network.exits, -1)  # there may be no exits
    routes = np.full((len(road), length, 2), NO_LANE)
    lengths = np.full(len(road), length)
    for step in range(length):
        routes[:, step, 0] = road
        count = lanes["exits_count"][road]
        lengths[(count == 0) & (lengths == length)] = step + 1
        turn = lanes["exits"][road] + generator.integers(np.maximum(count, 1))
        road = np.where(count > 0, after[turn], road)
    return routes, lengths


def nominal(envs: SetVectorEnv) -> dict[str, float]:
    """NOMINAL, with what the scenario makes of all its drivers, as intersections do."""
    template = envs.engine.template
    drivers = template[template["kind"] == IDM]
    here = [trait for trait, name in _ATTRIBUTES.items() if name in PARAMETERS and len(drivers)]
    return NOMINAL | {trait: drivers[trait][0] for trait in here}
