"""Looking ahead on the batch engine: what each action is worth, by driving copies of the scene on.

    planner = LookAhead()
    values = planner.values(envs)  # [num_envs, A]
    envs.step(planner.actions(envs))

With ``knows="all"`` the copies hold the simulator's whole state: what the other drivers want, and
the random numbers still to be drawn. That is what a driver could reach who knew all: a reference
and a teacher, and no driver that one could put on a road. With ``knows="observed"`` they hold what
can be seen, and what is not seen is guessed: see ``guess``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from highway_env.vehicle.behavior import IDMVehicle
from numpy.typing import NDArray

from esc_gym.fastsim.behavior import PARAMETERS, original_behavior
from esc_gym.fastsim.kernel import EGO, ITEMS, VEHICLES
from esc_gym.fastsim.records import CONTROLLED, IDM, LINEAR, NO_LANE
from esc_gym.fastsim.traits import TRAITS_OF
from esc_gym.vector.arguments import indices_of
from esc_gym.vector.environment import SetVectorEnv
from esc_gym.vector.generators import row
from esc_gym.vector.state import ROAD, RUNNING, State

NEUTRAL = "IDLE"
Knowledge = Literal["all", "observed"]
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


@dataclass(frozen=True)
class LookAhead:
    """Exhaustive look-ahead: all first actions, then one of a few actions to the horizon.

    horizon: policy steps looked ahead. free: in how many of them, from the first on, every action
    is tried. continuations: names of meta-actions, of which each is tried from then on; None: all
    that there are. The best of what begins with an action says what that is worth. discount:
    gamma, of the rewards. crash_cost: what a collision costs beyond what the scenario takes for it:
    where that is little, the best plan often ends in a crash.

    knows: "all", or only what is "observed"; then in ``futures`` guesses of the rest, over which
    returns are averaged. seed: of the guesses, which depend on it, and on an environment's own seed
    and time, and on nothing else.

    Raises ValueError for a horizon, free or futures below 1, free above the horizon, a discount out
    of [0, 1], no continuation, or another kind of knowledge.
    """

    horizon: int = 10
    free: int = 2
    continuations: tuple[str, ...] | None = ("IDLE", "SLOWER")
    discount: float = 0.95
    crash_cost: float = 10.0
    knows: Knowledge = "all"
    futures: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("horizon", "free", "futures"):
            if (number := getattr(self, name)) < 1:
                raise ValueError(f"{name}: expected at least 1, got {number}")
        if self.free > self.horizon:
            raise ValueError(f"free: expected at most the horizon, {self.horizon}, got {self.free}")
        if self.knows not in get_args(Knowledge):
            expected = " or ".join(map(repr, get_args(Knowledge)))
            raise ValueError(f"knows: expected {expected}, got {self.knows!r}")
        if not 0.0 <= self.discount <= 1.0:
            raise ValueError(f"discount: expected a number from 0 to 1, got {self.discount}")
        if self.continuations == ():
            raise ValueError("continuations: expected at least one name of a meta-action, got none")

    def sequences(self, envs: SetVectorEnv) -> NDArray[np.int64]:
        """What is tried: [A, A**(free - 1) * C, horizon], for A actions and C continuations.

        Raises ValueError where there are no meta-actions, or none of a continuation's name.
        """
        numbers = meta_actions(envs)
        names = tuple(numbers) if self.continuations is None else self.continuations
        if unknown := [name for name in names if name not in numbers]:
            raise ValueError(f"continuations: expected {', '.join(numbers)}, got {unknown[0]!r}")
        after = [numbers[name] for name in names]
        tried = [*product(*[range(len(numbers))] * self.free, after)]
        plans = np.repeat(tried, [*[1] * self.free, self.horizon - self.free], axis=1)
        return plans.reshape(len(numbers), -1, self.horizon)

    def values(self, envs: SetVectorEnv, indices: Sequence[int] | NDArray | None = None) -> NDArray:
        """Discounted return of each action within the horizon: [num_envs or len(indices), A].

        0 where an episode has ended. ``envs`` is left as it is. Raises ValueError where the batch
        engine does not simulate it (``envs.report()``).
        """
        chosen = indices_of(range(envs.num_envs) if indices is None else indices, envs.num_envs)
        plans = self.sequences(envs)
        tried, futures = plans.shape[:2], 1
        if self.knows == "observed":
            futures = self.futures
            envs = guess(envs, chosen, futures, self.seed)
            chosen = np.arange(envs.num_envs)
        count = tried[0] * tried[1]
        actions = np.tile(plans.reshape(count, self.horizon), (len(chosen), 1))
        returns = rollouts(envs, np.repeat(chosen, count), actions, self.discount, self.crash_cost)
        # What is done next has to be chosen before it is known which of the futures comes.
        return returns.reshape(-1, futures, *tried).mean(axis=1).max(axis=2)

    def actions(self, envs: SetVectorEnv) -> NDArray[np.int64]:
        """The best action of each environment; of equally good ones IDLE, else the first."""
        return best(self.values(envs), meta_actions(envs))


def best(values: NDArray, numbers: dict[str, int]) -> NDArray[np.int64]:
    """The action with the highest of ``values`` [K, A]; of equally good ones IDLE, else the first.

    numbers: of ``meta_actions``.
    """
    neutral = numbers.get(NEUTRAL, 0)
    return np.where(values[:, neutral] == values.max(axis=1), neutral, values.argmax(axis=1))


def rollouts(
    envs: SetVectorEnv, indices: Any, actions: NDArray, discount: float = 1.0,
    crash_cost: float = 0.0,
) -> NDArray:  # fmt: skip
    """Discounted returns of sequences of actions, driven in copies of environments.

    indices [K]: the environment that each begins in. actions [K, H, ...]. crash_cost: taken from
    the reward of a step that ends an episode with the ego crashed. Returns [K]; nothing is earned
    after the end of an episode.
    """
    copies = _copies(envs, indices)
    returns = np.zeros(copies.num_envs)
    for step in range(actions.shape[1]):
        _, rewards, terminated, truncated = copies.advance(actions[:, step])
        crashed = terminated & copies.engine.now.told.crashed
        returns += discount**step * (rewards - crash_cost * crashed)
        copies.rest(terminated | truncated)
    copies.close()
    return returns


def idm_actions(
    envs: SetVectorEnv, indices: Sequence[int] | NDArray | None = None
) -> NDArray[np.int64]:
    """What IDM and MOBIL would do in the ego's place, as the nearest meta-action: [num_envs], or of
    ``indices``.

    That driver is as the scenario's are, may change lanes at once, and wants the highest
    target speed that the ego's meta-actions have. Nearest is the action that aims at the lane at
    which it aims, and after a policy step is nearest to its speed; of equally near ones IDLE.
    ValueError without meta-actions, or where the batch engine does not simulate this.
    """
    numbers = meta_actions(envs)
    chosen = indices_of(range(envs.num_envs) if indices is None else indices, envs.num_envs)
    tried = [*range(len(numbers)), numbers.get(NEUTRAL, 0)]  # the last one: the driver itself
    copies = _copies(envs, np.repeat(chosen, len(tried)))
    state = copies.engine.state
    drivers = np.arange(len(tried) - 1, copies.num_envs, len(tried))
    places = drivers, state.counts[drivers, EGO]
    theirs = state.vehicles[places]
    theirs["kind"], theirs["changes_lanes"] = IDM, 1
    theirs["target_speed"] = copies.engine.env.unwrapped.action_type.target_speeds[-1]
    theirs["timer"] = IDMVehicle.LANE_CHANGE_DELAY
    for name, value in _nominal(envs).items():
        theirs[name] = value
    state.vehicles[places] = theirs
    copies.advance(np.tile(tried, len(chosen)))
    egos = state.vehicles[np.arange(copies.num_envs), state.counts[:, EGO]]
    lanes, speeds = (egos[name].reshape(-1, len(tried)) for name in ("target_lane", "speed"))
    copies.close()
    nearness = -np.abs(speeds[:, :-1] - speeds[:, -1:])
    elsewhere = lanes[:, :-1] != lanes[:, -1:]
    nearness[elsewhere & ~elsewhere.all(axis=1, keepdims=True)] = -np.inf
    return best(nearness, numbers)


def _nominal(envs: SetVectorEnv) -> dict[str, float]:
    """NOMINAL, with what the scenario makes of all its drivers, as intersections do."""
    template = envs.engine.template
    drivers = template[template["kind"] == IDM]
    here = [trait for trait, name in _ATTRIBUTES.items() if name in PARAMETERS and len(drivers)]
    return NOMINAL | {trait: drivers[trait][0] for trait in here}


def _copies(envs: SetVectorEnv, indices: Any) -> SetVectorEnv:
    """Copies that are driven on and left: resets would cost time, and draw random numbers."""
    copies = envs.fork(indices)
    copies.autoreset_mode = copies.engine.mode = AutoresetMode.DISABLED
    copies.rest(copies.engine.state.heads["over"] != RUNNING)
    return copies


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
    state, network, nominal = copies.engine.state, copies.engine.network, _nominal(envs)
    for e, head in enumerate(state.heads):
        entropy = [seed, e % futures, int(head["seed"]) + 1, int(head["elapsed"])]
        generator = np.random.default_rng(entropy)
        _leave_out(state, e, envs.set_spec.perception_distance)
        _guess_drivers(state, e, network, nominal, generator)
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
    state: State, e: int, network: Any, nominal: dict[str, float], generator: np.random.Generator
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
    for name, value in nominal.items():
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


def meta_actions(envs: SetVectorEnv) -> dict[str, int]:
    """Numbers of the meta-actions, by highway-env's names for them; ValueError without any."""
    space = envs.single_action_space
    base: Any = envs.engine.env.unwrapped if envs.engine else envs.materialise(0).unwrapped
    names = getattr(base.action_type, "actions_indexes", None)
    if names is None or not isinstance(space, gym.spaces.Discrete):
        raise ValueError(f"expected an environment with meta-actions, got the actions {space}")
    return dict(names)
