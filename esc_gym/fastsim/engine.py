"""Compiled policy steps in place of ``AbstractEnv._simulate``, on one environment."""

from __future__ import annotations

import struct
import warnings
from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from highway_env import utils
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import DiscreteMetaAction
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.vehicle.behavior import IDMVehicle

from esc_gym.fastsim import known
from esc_gym.fastsim.behavior import Behavior, original_behavior
from esc_gym.fastsim.known import vehicle_kind
from esc_gym.fastsim.network import Network, Unknown
from esc_gym.fastsim.records import KEEP, LEFT, LINEAR, MDP, RIGHT, SAMPLE_COLUMNS
from esc_gym.fastsim.traffic import Traffic

NO_SAMPLES = np.empty((0, SAMPLE_COLUMNS))
COMMANDS = {"LANE_LEFT": LEFT, "LANE_RIGHT": RIGHT}
SPEED_STEPS = {"FASTER": 1, "SLOWER": -1}
UNREADABLE = (KeyError, TypeError, AttributeError, ValueError, IndexError, struct.error)


@dataclass(frozen=True)
class Report:
    """How the steps of one environment were simulated since it was accelerated.

    compiled: policy steps that the compiled simulation ran.
    stock: policy steps that highway-env's own code ran, by reason.
    """

    compiled: int
    stock: dict[str, int] = field(default_factory=dict)

    def __str__(self) -> str:
        total = sum(self.stock.values())
        reasons = [f"  {count:,} stock: {reason}" for reason, count in self.stock.items()]
        return "\n".join([f"{self.compiled:,} policy steps compiled, {total:,} stock", *reasons])


@cache
def machine() -> tuple[Any, np.ndarray | None, str]:
    """(kernel module, numerics, ""), or why nothing can be compiled exactly on this machine."""
    try:
        same = known.source_digest() == known.SOURCE
    except OSError:
        same = False
    if not same:
        problem = "the installed highway-env is not the one that the kernels repeat"
    else:
        from esc_gym.fastsim import kernel
        from esc_gym.fastsim.cache import warm
        from esc_gym.fastsim.numerics import measure

        warm(lambda: (measure(kernel.check), kernel.run_nothing()))
        numerics, problem = measure(kernel.check)
        if numerics:
            return kernel, np.array(numerics, np.int64), ""
    warnings.warn(f"esc_gym: simulating with highway-env's own code: {problem}", stacklevel=2)
    return None, None, problem


class Simulation:
    """Replaces ``_simulate`` on one environment. A class, since environments copy and pickle.

    enabled: compiled code is used where it can be; otherwise only the traffic is kept apart.
    """

    def __init__(self, env: Any) -> None:
        self.env, self.enabled, self.behavior = env, False, Behavior()
        self.compiled, self.stock = 0, Counter()
        self._start()

    def _start(self) -> None:
        self._network: Network | None = None
        self._tables: Any = (np.empty((0, 0)),)
        self.forget()

    def forget(self) -> None:
        """Let go of the vehicles that were simulated last."""
        self._traffic, self._pinned = Traffic(), None

    def __getstate__(self) -> dict[str, Any]:
        kept = ("env", "enabled", "behavior", "compiled", "stock")
        return {name: vars(self)[name] for name in kept}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._start()

    def __call__(self, action: Any = None) -> None:
        """``AbstractEnv._simulate``."""
        env = self.env
        if env.road.vehicles != self._pinned:
            self.behavior.pin(env.road.vehicles)
            self._pinned = list(env.road.vehicles)
        frames = int(env.config["simulation_frequency"] // env.config["policy_frequency"])
        if problem := self._problem(frames):
            self.stock[problem] += 1
            type(env)._simulate(env, action)
            return
        meta_action = None
        if action is not None:
            meta_action = _meta_action(env.action_type, action)
            if meta_action is None:
                env.action_type.act(action)
        try:
            self._load(env.road)
            self._run(env.road, frames, 1 / env.config["simulation_frequency"], meta_action)
        except Unknown as unknown:
            self.stock[str(unknown)] += 1
            # A meta-action is still to be taken; any other is taken already.
            type(env)._simulate(env, action if meta_action else None)
            return
        env.steps += frames
        env.enable_auto_render = False
        self.compiled += 1

    def _problem(self, frames: int) -> str:
        """Why highway-env has to simulate this policy step itself; "" if it need not."""
        env = self.env
        if not self.enabled:
            return "acceleration is off"
        if known.patched():
            return "code of highway-env was replaced"
        if type(env)._simulate is not AbstractEnv._simulate:
            return f"{type(env).__name__} has a _simulate of its own"
        if env.viewer is not None and env.enable_auto_render:
            return "a viewer shows the sub-steps"
        if env.config["manual_control"]:
            return "manual control"
        if frames < 1 or env.steps % frames:
            return "policy steps that are not whole sub-steps"
        return machine()[2]

    def _load(self, road: Any) -> None:
        try:
            self._read(road)
        except UNREADABLE as error:
            raise Unknown(f"{type(error).__name__}: {error}") from error

    def _read(self, road: Any) -> None:
        """Everything into arrays; Unknown if anything cannot be simulated here."""
        regulated = known.is_regulated(type(road))
        if regulated is None or not known.RULES.isdisjoint(vars(road)):
            raise Unknown(f"road {type(road).__name__} with rules of its own")
        if road.record_history:
            raise Unknown("trajectories are recorded")
        if self._network is None or self._network.changed(road.network):
            self.forget()
            if self._network is None or not self._network.takes_over(road.network):
                self._network = Network(road.network)
        if regulated and not self._network.all_limited:
            raise Unknown("road rules on lanes without a speed limit")
        self._regulated = regulated
        self._traffic.gather(road, self._network, regulated)

    def _run(
        self, road: Any, frames: int, dt: float, meta_action: tuple[Any, int] | None = None
    ) -> None:
        """``frames`` times ``road.act(); road.step(dt)`` on what was loaded."""
        kernel, numerics, _ = machine()
        traffic, network = self._traffic, self._network
        shape = (len(network.lanes), len(traffic.items))
        if self._tables[0].shape != shape:
            self._tables = kernel.tables(*shape)
        rules_every, patience = 0, 0.0
        if self._regulated:
            rules_every = int(1 / dt / road.REGULATION_FREQUENCY)
            if rules_every < 1:
                raise Unknown("road rules that are checked more often than sub-steps are made")
            patience = road.YIELD_DURATION * road.REGULATION_FREQUENCY
        collecting = frames * traffic.kinds.count(LINEAR)
        samples = np.empty((collecting, SAMPLE_COLUMNS)) if collecting else NO_SAMPLES
        progress = np.zeros((1, kernel.COMMAND + 1), np.int64)
        ego = 0
        if meta_action:
            vehicle, progress[0, kernel.COMMAND] = meta_action
            ego = traffic.controlled(vehicle)
        items = len(traffic.items)
        counts = np.array([[traffic.n, items, getattr(road, "steps", 0), ego]], np.int64)
        links = network.links(bool(road.neighbour_vehicles_connected_lanes))
        while True:
            waiting = kernel.run(
                traffic.records[None], counts, traffic.routes[None], network.records,
                *self._tables, *links, network.exits, network.poses, network.widths, samples,
                numerics, progress, 0, 1, frames, dt, rules_every, patience,
            )  # fmt: skip
            if waiting == kernel.NOT_FINITE:
                raise Unknown("a vehicle with NaN, infinite or enormous state")
            if waiting == kernel.DONE:
                break
            traffic.follow_road(waiting)
        traffic.scatter(samples[: progress[0, kernel.SAMPLES]])
        if self._regulated:
            road.steps += frames

    def substeps(self, road: Any, count: int, dt: float) -> None:
        """``road.act(); road.step(dt)``, ``count`` times."""
        try:
            self._load(road)
            self._run(road, count, dt)
        except Unknown:
            for _ in range(count):
                road.act()
                road.step(dt)


class Reset:
    """Replaces ``_reset``: the scene that a fresh process would make, whatever ran before."""

    def __init__(self, env: Any, simulation: Simulation) -> None:
        self.env, self.simulation, self.behavior = env, simulation, simulation.behavior

    def __call__(self) -> None:
        """``AbstractEnv._reset``."""
        env = self.env
        self.simulation.forget()
        vehicle_type: Any = utils.class_from_path(env.config["other_vehicles_type"])
        with original_behavior(vehicle_type):
            type(env)._reset(env)
            self.behavior.learn({IDMVehicle, vehicle_type, *map(type, env.road.vehicles)})
        self.behavior.pin(env.road.vehicles)


class MakeVehicles:
    """Replaces ``IntersectionEnv._make_vehicles``, which simulates three seconds of traffic.

    It calls ``road.act()`` and ``road.step(dt)`` in turn and looks at nothing in between, so its
    sub-steps are put off until it spawns the next vehicle, and then run in one go.
    """

    def __init__(self, env: Any, simulation: Simulation) -> None:
        self.env, self.simulation, self._intervals = env, simulation, []

    def __call__(self, *arguments: Any) -> None:
        """``IntersectionEnv._make_vehicles``."""
        env, road = self.env, self.env.road
        hooks = {"act": _nothing, "step": self._intervals.append}
        if not self.simulation.enabled or machine()[2] or known.patched():
            type(env)._make_vehicles(env, *arguments)
            return
        vars(road).update(hooks)
        env._spawn_vehicle = self._spawn
        try:
            type(env)._make_vehicles(env, *arguments)
            self._catch_up()
        finally:
            del env._spawn_vehicle
            for name in hooks:
                vars(road).pop(name, None)

    def _spawn(self, *arguments: Any, **options: Any) -> Any:
        self._catch_up()
        return type(self.env)._spawn_vehicle(self.env, *arguments, **options)

    def _catch_up(self) -> None:
        if not self._intervals:
            return
        road = self.env.road
        hooks = {name: vars(road).pop(name) for name in ("act", "step")}
        self.simulation.substeps(road, len(self._intervals), self._intervals[0])
        self._intervals.clear()
        vars(road).update(hooks)


def _nothing() -> None:
    pass


def _meta_action(action_type: Any, action: Any) -> tuple[Any, int] | None:
    """(vehicle, command) of ``DiscreteMetaAction.act``; None if it is not that.

    A change of speed is made here. It can be made twice, as stock code would in our place.
    """
    known_type = type(action_type).act is DiscreteMetaAction.act and "act" not in vars(action_type)
    vehicle = action_type.controlled_vehicle if known_type else None
    if vehicle is None or vehicle_kind(type(vehicle)) != MDP:
        return None
    name = action_type.actions[int(action)]
    if step := SPEED_STEPS.get(name):
        index = vehicle.speed_to_index(vehicle.speed) + step
        vehicle.speed_index = int(np.clip(index, 0, vehicle.target_speeds.size - 1))
        vehicle.target_speed = vehicle.index_to_speed(vehicle.speed_index)
    return vehicle, COMMANDS.get(name, KEEP)


def isolate(env: Any) -> Simulation:
    """Keep the traffic of ``env`` apart from other environments of the process, on stock code."""
    base: Any = _base(env)
    simulation = vars(base).get("_simulate")
    if not isinstance(simulation, Simulation):
        simulation = base._simulate = Simulation(base)
        base._reset = Reset(base, simulation)
        if getattr(type(base), "_make_vehicles", None) is IntersectionEnv._make_vehicles:
            base._make_vehicles = MakeVehicles(base, simulation)
    return simulation


def accelerate(env: Any) -> Any:
    """Simulate ``env`` with compiled code, on exactly highway-env's trajectories.

    Args:
        env: any highway-env environment, wrapped or not, with any observation type.

    Returns ``env`` itself. Only this instance changes; ``env.unwrapped`` stays the highway-env
    environment that it was, for rendering, copying, and changing vehicles by hand. Whatever the
    compiled simulation does not know, highway-env's own code simulates; ``report(env)`` says what.
    From the next reset on, the trajectories are those of a fresh process (intersection-v0 changes
    the drivers of every environment of a process).

    Raises TypeError if ``env`` is not a highway-env environment.
    """
    isolate(env).enabled = True
    return env


def report(env: Any) -> Report:
    """How the steps of ``env`` were simulated so far."""
    simulation = vars(_base(env)).get("_simulate")
    if not isinstance(simulation, Simulation):
        return Report(0, {})
    return Report(simulation.compiled, dict(simulation.stock))


def _base(env: Any) -> AbstractEnv:
    base = env.unwrapped
    if not isinstance(base, AbstractEnv):
        raise TypeError(
            f"esc_gym.accelerate expected a highway-env environment, got {type(base).__name__}. "
            'Make one with gym.make("highway-v0") after import highway_env.'
        )
    return base
