"""The same episodes by highway-env's own code and accelerated, compared to the last bit.

A snapshot holds everything that a step returns and everything that the next step depends on. All
stock episodes are recorded first, because highway-env's intersections write class attributes for
the whole process: each side runs in what a new process has.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from highway_env.road.lane import AbstractLane
from highway_env.vehicle.behavior import AggressiveVehicle, DefensiveVehicle
from highway_env.vehicle.objects import RoadObject

import esc_gym
from esc_gym.fastsim import report
from esc_gym.fastsim.behavior import PARAMETERS, original_behavior

Make = Callable[[], gym.Env]
Snapshot = dict[str, Any]
Recording = list[tuple[str, Snapshot]]

RETURNED = ("observation", "reward", "terminated", "truncated", "info")
# Attributes that our side may add to a vehicle; the parameters are compared by their values.
OURS = {"set_id", *PARAMETERS}


def lockstep(
    stock: Make,
    ours: Make | None = None,
    *,
    seeds: Iterable[int] = (0, 1),
    steps: int = 15,
    compiled: bool | None = True,
) -> Recording:
    """Raise AssertionError at the first difference; return what the stock side did.

    stock: makes the stock environment. ours: makes the accelerated one; default: ``stock()``,
    accelerated. compiled: that all steps ran compiled (True), none did (False), either (None).
    """
    with fresh_process():
        expected = list(record(stock(), seeds, steps))
    with fresh_process():
        env = ours() if ours else esc_gym.accelerate(stock())
    with fresh_process():  # what making it has done to highway-env's classes must not matter
        for (when, a), (_, b) in zip(expected, record(env, seeds, steps), strict=True):
            found = list(differences(a, b))
            assert not found, f"{when}: {len(found)} differences\n" + "\n".join(
                f"  {where}: stock {x!r:.200}, accelerated {y!r:.200}" for where, x, y in found[:6]
            )
        if compiled is not None:
            total = sum("step" in when for when, _ in expected)
            counted = (report(env).compiled, sum(report(env).stock.values()))
            assert counted == ((total, 0) if compiled else (0, total)), str(report(env))
    return expected


@contextmanager
def fresh_process() -> Iterator[None]:
    """highway-env's classes as their source has them, and seed 0 for whatever nobody seeds."""
    make = seeding.np_random  # also of the action space, which every reset makes anew and samples
    with ExitStack() as stack:
        for leaf in (AggressiveVehicle, DefensiveVehicle):
            stack.enter_context(original_behavior(leaf))
        patch = mock.patch.object(seeding, "np_random", lambda seed=None: make(seed or 0))
        stack.enter_context(patch)
        yield


def record(env: gym.Env, seeds: Iterable[int], steps: int) -> Iterator[tuple[str, Snapshot]]:
    """(when, snapshot) of every reset and step; episodes go on for two steps past their end."""
    for seed in seeds:
        observation, info = env.reset(seed=seed)
        yield f"seed {seed}, reset", snapshot(env, {"observation": observation, "info": info})
        rng, last = np.random.default_rng(seed), steps - 1
        for step in range(steps):
            drivers = list(env.unwrapped.road.vehicles)
            returned = env.step(choose(env.action_space, rng, sensible=seed % 2 == 1))
            state = snapshot(env, dict(zip(RETURNED, returned, strict=True)), drivers)
            yield f"seed {seed}, step {step}", state
            if np.all(returned[2]) or returned[3]:
                last = min(last, step + 2)
            if step == last:
                break


def choose(space: gym.Space, rng: np.random.Generator, sensible: bool) -> Any:
    """A uniform action, or a sensible one: mostly straight on, in gentle curves."""
    if isinstance(space, gym.spaces.Tuple):
        return tuple(choose(part, rng, sensible) for part in space.spaces)
    if isinstance(space, gym.spaces.Box):
        return ((0.03 if sensible else 1) * rng.uniform(-1, 1, space.shape)).astype(space.dtype)
    odds = {3: [0.4, 0.3, 0.3], 5: [0.1, 0.5, 0.15, 0.05, 0.2]}.get(space.n) if sensible else None
    return int(rng.choice(space.n, p=odds))


def snapshot(env: gym.Env, returned: dict[str, Any], drivers: Iterable[Any] = ()) -> Snapshot:
    """drivers: vehicles that were there when the step began; their parameters, it has used."""
    base = env.unwrapped
    road, objects = base.road, [*base.road.vehicles, *base.road.objects]
    names = {id(lane): f"lane {index}" for index, lane in road.network.lanes_dict().items()}
    names |= {id(thing): f"object {number}" for number, thing in enumerate(objects)}
    state = {
        "controlled": base.controlled_vehicles,
        "generator": base.np_random.bit_generator.state,
        "generator shared": road.np_random is base.np_random,
        "time": base.time,
        "steps": base.steps,
        "road steps": getattr(road, "steps", None),
    }
    things = {
        f"{number} ({type(thing).__name__})": frozen_object(thing, names, road)
        for number, thing in enumerate(objects)
    }
    state |= {
        f"{name} of {names[id(driver)]}": getattr(driver, name, None)
        for driver in drivers
        if id(driver) in names
        for name in PARAMETERS
    }
    return {"object": things} | frozen(state | returned, names)


def frozen_object(thing: RoadObject, names: Mapping[int, str], road: Any) -> dict[str, Any]:
    """All its attributes; lanes and other objects by their names."""
    own = {name: value for name, value in vars(thing).items() if name not in OURS}
    own |= {"class": type(thing).__name__, "road": own["road"] is road}
    return frozen(own, names)


def frozen(value: Any, names: Mapping[int, str]) -> Any:
    """A copy, in builtins and arrays, that the simulation does not change any more."""
    if id(value) in names:
        return names[id(value)]
    match value:
        case np.bool_() | np.integer() | np.float64():
            return value.item()
        case None | str() | bool() | int() | float():
            return value
        case np.ndarray() | np.generic():
            array = np.array(value)
            if array.dtype.kind == "f":
                array[np.isnan(array)] = np.nan  # one of the many
            return array
        case Mapping():
            return {key: frozen(part, names) for key, part in value.items()}
        case tuple():
            return tuple(frozen(part, names) for part in value)
        case list() | deque():
            return [frozen(part, names) for part in value]
        case RoadObject():  # not on the road: a goal, a copy in a history
            return frozen_object(value, names, None)
        case AbstractLane():
            return "a lane of another network"
        case Callable():  # a method that a user replaced
            return value.__name__
    raise TypeError(f"lockstep does not know how to compare {value!r}")


def differences(a: Any, b: Any, where: str = "") -> Iterator[tuple[str, Any, Any]]:
    """(place, value in a, value in b) wherever two snapshots differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        for key in a | b:
            place = f"{where} {key}".lstrip()
            yield from differences(a.get(key, "(missing)"), b.get(key, "(missing)"), place)
    elif isinstance(a, list | tuple) and type(a) is type(b) and len(a) == len(b):
        for index, (x, y) in enumerate(zip(a, b, strict=True)):
            yield from differences(x, y, f"{where}[{index}]")
    elif not equal(a, b):
        yield where, a, b


def equal(a: Any, b: Any) -> bool:
    """Bit equality of leaves. 1 and 1.0 are equal, True and 1 are not, 0.0 and -0.0 are not."""
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    if {type(a), type(b)} <= {int, float}:
        same = a == b and math.copysign(1, a) == math.copysign(1, b)
        return same or (a != a and b != b)
    return type(a) is type(b) and bool(a == b)


def happened(recording: Recording, event: Callable[[dict[str, Any]], Any]) -> bool:
    """Whether ``event`` was true of some object's attributes at some time: tests of the tests."""
    return any(event(thing) for _, state in recording for thing in state["object"].values())


def crashed(thing: dict[str, Any]) -> bool:
    return thing["crashed"]


def changing_lane(thing: dict[str, Any]) -> bool:
    """By its own decision: a vehicle of the traffic, within one road."""
    here, target = thing["lane_index"], thing.get("target_lane_index")
    return "timer" in thing and here[:2] == target[:2] and here != target
