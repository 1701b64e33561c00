"""The batch engine: arrays are the truth, and one compiled call does what E environments do.

Data flows one way: seeds -> scene arrays -> sub-steps -> reward, end -> reset in place ->
observation. highway-env's objects are made once, to read a configuration off them.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import pairwise
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from highway_env import utils
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import ContinuousAction, DiscreteAction
from highway_env.vehicle.behavior import (
    AggressiveVehicle,
    DefensiveVehicle,
    IDMVehicle,
    LinearVehicle,
)
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject

from esc_gym.fastsim import kernel, known
from esc_gym.fastsim.engine import machine
from esc_gym.fastsim.network import Network, Unknown
from esc_gym.fastsim.records import SAMPLE_COLUMNS
from esc_gym.fastsim.traffic import Traffic
from esc_gym.vector import observe
from esc_gym.vector.actions import Actions
from esc_gym.vector.generators import generator, row
from esc_gym.vector.kernel import RESET, Told, decide
from esc_gym.vector.scenes import highway
from esc_gym.vector.state import ROAD, SHUFFLE, State

FAMILIES = (highway,)
DRIVERS = (IDMVehicle, LinearVehicle, AggressiveVehicle, DefensiveVehicle)
# What of highway-env all families repeat, besides the sub-steps.
REPEATED = known.Repeated(
    "7ce9444fbf2486dd1434eaba5cbf2c52fcb71b325ce30cef79e6edc9c6b4ce88",
    (AbstractEnv, "step reset _info vehicle"),
    (utils, "lmap near_split"),
    (ContinuousAction, "get_action act"),
    (DiscreteAction, "act"),
    (RoadObject, "__init__ on_road"),
    (Vehicle, "__init__ create_random"),
    (ControlledVehicle, "__init__"),
    (MDPVehicle, "__init__"),
    (IDMVehicle, "__init__ randomize_behavior"),
    (LinearVehicle, "__init__ randomize_behavior"),
)


def family_of(base: Any) -> tuple[Any, str]:
    """(family, "") of a highway-env environment, or (None, why the engine does not know it)."""
    if problem := machine()[2]:
        return None, problem
    family = next((family for family in FAMILIES if type(base) in family.CLASSES), None)
    if family is None:
        return None, f"scenario {type(base).__name__}"
    if known.patched() or any(code.differs() for code in (REPEATED, family.REPEATED)):
        return None, "code of highway-env was replaced"
    driver = utils.class_from_path(base.config["other_vehicles_type"])
    if driver not in DRIVERS:
        return None, f"traffic of {driver.__name__}"
    if base.config["manual_control"] or base.config["show_trajectories"]:
        return None, "manual control, or trajectories that are shown"
    if base.config["simulation_frequency"] < base.config["policy_frequency"]:
        return None, "policy steps that are shorter than sub-steps"
    reason = (
        Actions.unknown(base.action_type)
        or observe.unknown(base.observation_type)
        or family.unknown(base)
    )
    return (None, reason) if reason else (family, "")


def behavior_ranges(driver: Any) -> np.ndarray:
    """[6, 2]: what ``randomize_behavior`` draws from: delta, and linear parameters (else zero)."""
    ranges = np.zeros((6, 2))
    ranges[0] = driver.DELTA_RANGE
    if issubclass(driver, LinearVehicle):
        ranges[1:4], ranges[4:] = driver.ACCELERATION_RANGE.T, driver.STEERING_RANGE.T
    return ranges


class Outputs:
    """What E environments returned last. See ``observe.Output``, ``kernel.Told``."""

    def __init__(self, space: Any, count: int, rewards: int) -> None:
        n = len(space["mask"].shape) and space["mask"].n
        self.seen = observe.Output(
            np.zeros((count, *space["ego"].shape), np.float32),
            np.zeros((count, *space["vehicles"].shape), np.float32),
            np.zeros((count, n), np.int8),
            np.full((count, n), -1),
            np.zeros((count, 2), np.int64),
        )
        self.told = Told(np.zeros(count), np.zeros(count, np.bool_), np.zeros((count, rewards)))

    def arrays(self) -> tuple[np.ndarray, ...]:
        return (*self.seen, *self.told)


class Engine:
    """E copies of one highway-env environment with ``SetObservation``, as arrays.

    env: the environment, reset once; family: its entry of FAMILIES. limit: policy steps until an
    episode is truncated, 0 for none. same_step: reset in the step that ends an episode.
    """

    def __init__(
        self, env: Any, family: Any, count: int, threads: int, limit: int, same_step: bool
    ) -> None:
        base = env.unwrapped
        config = base.config
        self.env, self.family, self.count = env, family, count
        self.limit, self.same_step = limit, same_step
        network, traffic = Network(base.road.network), Traffic()
        traffic.gather(base.road, network, bool(known.is_regulated(type(base.road))))
        self.network = network
        self.template = traffic.records.copy()
        self.template["collects"] = 0
        self.state = State.empty(count, len(traffic.items), traffic.routes.shape[1])
        self.state.counts[:] = traffic.n, len(traffic.items), 0, traffic.controlled(base.vehicle)
        self.state.routes[:] = traffic.routes
        self.state.generators[:, SHUFFLE] = row(np.random.default_rng())
        # Of reset(seed=...); None: never reset. The seed of a reset without one is drawn.
        self.seeds: list[int | None] = [None] * count
        self.actions = Actions(base.action_type, count)
        self.frames = int(config["simulation_frequency"] // config["policy_frequency"])
        self.period, self.dt = 1 / config["policy_frequency"], 1 / config["simulation_frequency"]
        driver = utils.class_from_path(config["other_vehicles_type"])
        self.constants = family.constants(base, behavior_ranges(driver))
        self.spec = observe.spec_of(base.observation_type)
        self.now = Outputs(env.observation_space, count, len(family.REWARDS))
        self.final = Outputs(env.observation_space, count, len(family.REWARDS))
        self.rewards, self.ends = np.zeros(count), np.zeros((count, 2), np.bool_)
        self.progress = np.zeros((count, kernel.COMMAND + 1), np.int64)
        self._prepare(threads, bool(config["neighbour_vehicles_connected_lanes"]))

    def _prepare(self, threads: int, connected: bool) -> None:
        """Put the arguments of the kernels together, and the threads that call them."""
        threads = min(threads, self.count)
        network, numerics = self.network, machine()[1]
        edges = np.linspace(0, self.count, threads + 1).astype(int).tolist()
        items = self.state.vehicles.shape[1] - 1
        roads = (
            network.exits,
            network.poses,
            network.widths,
            np.empty((1, SAMPLE_COLUMNS)),
            numerics,
        )
        links = network.links(connected)
        state = self.state
        self._shares = []
        for first, last in pairwise(edges):
            tables = kernel.tables(len(network.lanes), items)
            scene = network.records, *tables, *links, *roads
            scenes = state.vehicles, state.counts, state.routes, *scene
            run = *scenes, self.progress
            settle = (
                *(*scenes, state.ids, state.heads, state.generators, self.template),
                *(self.constants, *self.spec, *self.now.arrays(), *self.final.arrays()),
                *(self.rewards, self.ends),
            )
            self._shares.append((first, last, run, settle))
        self._pool = ThreadPoolExecutor(threads - 1) if threads > 1 else None

    def generators(self) -> tuple[np.random.Generator, ...]:
        """Copies of highway-env's generators."""
        return tuple(generator(numbers) for numbers in self.state.generators[:, ROAD])

    def close(self) -> None:
        if self._pool:
            self._pool.shutdown()

    def _share_out(self, work: Any, *arguments: Any) -> None:
        """``work`` on all environments, a part of them in each thread."""
        others = [self._pool.submit(work, share, *arguments) for share in self._shares[1:]]  # type: ignore[union-attr]
        work(self._shares[0], *arguments)
        wait(others)
        for other in others:
            other.result()

    def reset(self, seeds: Sequence[int | None], mask: np.ndarray) -> None:
        """Make new scenes where ``mask`` [E] says so, from the seeds or from where they are."""
        begun = {
            e: seeding.np_random(seeds[e])
            for e in np.flatnonzero(mask).tolist()
            if seeds[e] is not None or self.seeds[e] is None
        }  # all of them first: a bad seed changes nothing
        for e, (generator_, seed) in begun.items():
            self.state.generators[e, ROAD], self.seeds[e] = row(generator_), seed
            if seeds[e] is not None:
                self.state.generators[e, SHUFFLE] = row(np.random.default_rng([seed, 0x5E7]))
        self.state.heads["over"][mask] = RESET
        self._share_out(self._settle, 0.0)

    def step(self, actions: Any) -> None:
        """One policy step of each environment. ValueError, and nothing is done, for bad actions."""
        taken = self.actions.taken(self.actions.checked(actions))
        self._share_out(self._step, taken)

    def _step(self, share: Any, taken: np.ndarray) -> None:
        first, last, run, _ = share
        state, actions = self.state, self.actions
        decide(
            state.vehicles, state.counts, state.heads, self.progress, taken, actions.commands,
            actions.speed_steps, actions.target_speeds, actions.controls,
            actions.speed_range, first, last, self.frames,
        )  # fmt: skip
        found = kernel.run(*run, first, last, self.frames, self.dt, 0, 0.0)
        if found == kernel.NOT_FINITE:
            raise ValueError("a vehicle with NaN, infinite or enormous state")
        if found != kernel.DONE:
            raise Unknown("a route that leads elsewhere")
        self._settle(share, self.period)

    def _settle(self, share: Any, period: float) -> None:
        first, last, _, settle = share
        self.family.settle(*settle, first, last, self.frames, period, self.limit, self.same_step)
