"""The batch engine: arrays are the truth, and one compiled call does what E environments do.

Data flows one way: seeds -> scene arrays -> sub-steps -> reward, end -> reset in place ->
observation. highway-env's objects are made once, to read a configuration off them.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from copy import copy
from itertools import pairwise
from threading import Lock
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from highway_env import utils

from esc_gym.fastsim import kernel, known
from esc_gym.fastsim.engine import machine
from esc_gym.fastsim.network import Network
from esc_gym.fastsim.records import SAMPLE_COLUMNS, STATE_FLOATS, STATE_INTS
from esc_gym.fastsim.traffic import Traffic
from esc_gym.vector import observe
from esc_gym.vector.actions import Actions, sizes_of
from esc_gym.vector.families import capacity_of
from esc_gym.vector.generators import generator, row
from esc_gym.vector.kernel import COLLISIONS, DRIVING, NOTHING, Told, decide, look_all
from esc_gym.vector.measures import Measured
from esc_gym.vector.objects import follow_road
from esc_gym.vector.scenes.roads import ROUTE_LENGTH, Plans, behavior_ranges
from esc_gym.vector.state import ROAD, RUNNING, SHUFFLE, UNBORN, State

# Parts of a batch for each thread, environments in a part at least, and few environments.
PARTS, LEAST, FEW = 2, 4, 16


class Outputs:
    """What E environments returned last. See ``observe.Output``, ``kernel.Told``."""

    def __init__(self, space: Any, count: int, rewards: int) -> None:
        self.seen = observe.Output.empty(space, count)
        self.told = Told(np.zeros(count), np.zeros(count, np.bool_), np.zeros((count, rewards)))

    def arrays(self) -> tuple[np.ndarray, ...]:
        return (*self.seen, *self.told)

    def copy_from(self, other: Outputs, here: Any, there: Any) -> None:
        """Take what ``other`` holds of the environments ``there``."""
        for mine, theirs in zip(self.arrays(), other.arrays(), strict=True):
            mine[here] = theirs[there]


class Engine:
    """E copies of one highway-env environment with ``SetObservation``, as arrays.

    env: the environment, reset once; family: its entry of FAMILIES. limit: policy steps until an
    episode is truncated, 0 for none. mode: what follows the end of an episode; DISABLED leaves
    alone what has ended.
    """

    def __init__(
        self, env: Any, family: Any, count: int, threads: int, limit: int, mode: AutoresetMode
    ) -> None:
        base = env.unwrapped
        config = base.config
        self.env, self.family = env, family
        self.limit, self.mode = limit, mode
        network, traffic = Network(base.road.network), Traffic()
        traffic.gather(base.road, network, bool(known.is_regulated(type(base.road))))
        self.network = network
        self.template = _template(traffic, capacity_of(family, base), base.vehicle)
        items, n = len(self.template) - 1, traffic.n
        state, objects = State.empty(count, items, ROUTE_LENGTH), len(traffic.items) - n
        state.counts[:] = items - objects, items, 0, traffic.controlled(base.vehicle)
        state.generators[:, SHUFFLE] = row(np.random.default_rng())
        self.actions = Actions(base.action_type)
        self.frames = int(config["simulation_frequency"] // config["policy_frequency"])
        self.period, self.dt = 1 / config["policy_frequency"], 1 / config["simulation_frequency"]
        driver = utils.class_from_path(config["other_vehicles_type"])
        plans = Plans(base.road, network, getattr(family, "DESTINATIONS", ()))
        self.constants = np.array(family.constants(base, network), float)
        self.behavior = behavior_ranges(driver), plans.steps, plans.lengths
        if hasattr(family, "lane"):
            state.heads["lane"] = family.lane(base, network)
        self.spec = observe.spec_of(base.observation_type)
        self.links = network.links(bool(config["neighbour_vehicles_connected_lanes"]))
        # Of roads with rules; see ``kernel.run``.
        self.rules_every, self.patience = 0, 0.0
        if known.is_regulated(type(base.road)):
            self.rules_every = int(1 / self.dt / base.road.REGULATION_FREQUENCY)
            self.patience = base.road.YIELD_DURATION * base.road.REGULATION_FREQUENCY
        self.warm_up = family.warm_up(base) if hasattr(family, "warm_up") else 0
        self.faulty = 0  # the environment that the last exception was about
        self._threads, self._objects, self._asking = threads, env.unwrapped, Lock()
        self._allocate(state)

    def _allocate(self, state: State) -> None:
        """Room for what the environments of ``state`` return, and their shares of the threads."""
        self.state, count = state, len(state.heads)
        space = self.env.observation_space
        rewards = len(self.family.REWARDS) + len(getattr(self.family, "EXTRAS", ()))
        self.now, self.final = Outputs(space, count, rewards), Outputs(space, count, rewards)
        self.rewards, self.ends = np.zeros(count), np.zeros((count, 2), np.bool_)
        # Where the last step began a new episode in place of a step; and a mask of all.
        self.begun, self.everywhere = np.zeros(count, bool), np.ones(count, bool)
        self.progress = np.zeros((count, kernel.COMMAND + 1), np.int64)
        # How the egos drive, and what of it steps and resets see to.
        self.measured: Measured = Measured.empty(count)
        self.watching, self.born = NOTHING, False
        network = self.network
        parts = 1 if self._threads == 1 else min(PARTS * self._threads, -(-count // LEAST))
        edges = np.linspace(0, count, parts + 1).astype(int).tolist()
        samples, numerics = np.empty((1, SAMPLE_COLUMNS)), machine()[1]
        self._shares = []
        for first, last in pairwise(edges):
            tables = kernel.tables(len(network.lanes), state.ids.shape[1])
            scenes = (
                state.vehicles, state.counts, state.routes, network.records, *tables, *self.links,
                network.exits, network.poses, network.widths, samples, numerics,
            )  # fmt: skip
            self._shares.append((first, last, scenes))
        self._pool: ThreadPoolExecutor | None = None

    def arrays(self) -> tuple[np.ndarray, ...]:
        """What a snapshot holds: the state, and what was returned last."""
        return (*self.state.arrays(), *self.now.arrays())

    def fork(self, indices: np.ndarray) -> Engine:
        """An engine of copies of some environments, as many times as asked for."""
        other = copy(self)
        other._allocate(self.state.taken(indices))
        other.now.copy_from(self.now, slice(None), indices)
        return other

    def go_back(self, chosen: np.ndarray, kept: Sequence[np.ndarray]) -> None:
        """Put rows of ``arrays`` in the place of some environments, all but the generators."""
        state = self.state
        own = state.generators[chosen], state.heads["seed"][chosen]
        for mine, theirs in zip(self.arrays(), kept, strict=True):
            mine[chosen] = theirs
        state.generators[chosen], state.heads["seed"][chosen] = own
        there = np.isin(np.arange(len(self.ends)), chosen)
        self._share_out(self._look, there, False, self.watching, alone=len(chosen) < FEW)

    def generators(self) -> tuple[np.random.Generator, ...]:
        """Copies of highway-env's generators."""
        return tuple(generator(numbers) for numbers in self.state.generators[:, ROAD])

    def close(self) -> None:
        if self._pool:
            self._pool.shutdown()

    def _share_out(self, work: Any, *arguments: Any, alone: bool = False) -> None:
        """``work`` on all environments; threads that are free take the next part, if not alone."""
        if alone:
            work((0, len(self.ends), self._shares[0][2]), *arguments)
            return
        shares = iter(self._shares)

        def take() -> None:
            for share in shares:
                work(share, *arguments)

        helpers = min(self._threads, len(self._shares)) - 1
        if self._pool is None and helpers:
            self._pool = ThreadPoolExecutor(helpers)
        pool: Any = self._pool
        others = [pool.submit(take) for _ in range(helpers)]
        take()
        # Those that did not wake up in time have nothing to do any more.
        late = [other for other in others if not other.cancel()]
        wait(late)
        for other in late:
            other.result()

    def reset(self, seeds: Sequence[int | None], mask: np.ndarray) -> None:
        """Make new scenes where ``mask`` [E] says so, from the seeds or from where they are."""
        unseeded = self.state.heads["over"] == UNBORN
        begun = {
            e: seeding.np_random(seeds[e])
            for e in np.flatnonzero(mask).tolist()
            if seeds[e] is not None or unseeded[e]
        }  # all of them first: a bad seed changes nothing
        for e, (generator_, seed) in begun.items():
            self.state.generators[e, ROAD] = row(generator_)
            self.state.heads["seed"][e] = seed if seed < 2**63 else -1
            if seeds[e] is not None:
                self.state.generators[e, SHUFFLE] = row(np.random.default_rng([seed, 0x5E7]))
        # For a few, which begin in every step, to wake up the others would take longer.
        self._share_out(self._begin, mask, alone=mask.sum() < FEW)

    def step(self, actions: Any) -> None:
        """One policy step of each environment. ValueError, and nothing is done, for bad actions."""
        actions = self.actions.checked(actions, len(self.ends))
        state, kinds = self.state, self.actions
        taken, controls = kinds.taken(actions)
        state.heads["single"] = actions.dtype == np.float32
        over = state.heads["over"] != RUNNING
        self.begun = over & (self.mode is AutoresetMode.NEXT_STEP)
        decide(
            state.vehicles, state.counts, state.heads, self.progress, taken, kinds.commands,
            kinds.speed_steps, kinds.target_speeds, controls, kinds.speed_range, self.frames,
        )  # fmt: skip
        self._share_out(self._step, ~over, sizes_of(actions))

    def _step(self, share: Any, driven: np.ndarray, sizes: np.ndarray) -> None:
        first, last, scenes = share
        state, frames, family = self.state, self.frames, self.family
        # Most families observe after everything else that happens in a step.
        early, late = hasattr(family, "prepare_all"), hasattr(family, "go_on_all")
        if early:
            family.prepare_all(*scenes, state.heads, self.constants, first, last)
            self._look(share, driven, measuring=NOTHING)
        self._run(share, frames)
        family.judge_all(
            *scenes, state.heads, self.constants, self.now.told.rewards, self.rewards, self.ends,
            sizes, first, last, frames, self.period, self.limit,
        )  # fmt: skip
        if self.begun[first:last].any():
            self._begin(share, self.begun)
        self._look(share, driven, not early, NOTHING if late else self.watching)
        if late:
            self._change(share, driven, family.go_on_all)
            self._look(share, driven, False, self.watching)
        ended: Any = self.ends.any(axis=1) if self.mode is AutoresetMode.SAME_STEP else self.begun
        if self.mode is AutoresetMode.SAME_STEP and ended[first:last].any():
            self.final.copy_from(self.now, slice(first, last), slice(first, last))
            self._begin(share, ended)

    def _run(self, share: Any, frames: int) -> None:
        """Sub-steps of those environments whose ``progress`` is not there yet."""
        first, last, scenes = share
        waiting, state = self.progress[first:last, kernel.FRAME] < frames, self.state
        while True:
            found = kernel.run(
                *scenes, self.progress, first, last, frames, self.dt, self.rules_every,
                self.patience,
            )  # fmt: skip
            if found == kernel.DONE:
                break
            if found == kernel.NOT_FINITE:
                left = self.progress[first:last, kernel.FRAME] < frames
                self.faulty = first + int(np.argmax(left))
                raise ValueError(
                    f"environment {self.faulty}: a vehicle with NaN, infinite or enormous state"
                )
            (e,) = first + np.flatnonzero(self.progress[first:last, kernel.RESUMED])
            with self._asking:
                follow_road(self._objects, state, int(e), found)
        if self.rules_every:
            state.counts[first:last, kernel.ROAD_STEPS] += frames * waiting

    def _begin(self, share: Any, chosen: np.ndarray) -> None:
        """New scenes where ``chosen`` [E] says so, and what they look like."""
        first, last, _ = share
        self._change(share, chosen, self.family.begin_all)
        if self.warm_up:
            self.progress[first:last] = 0
            self.progress[first:last, kernel.FRAME] = np.where(chosen[first:last], 0, self.warm_up)
            self._run(share, self.warm_up)
            self._change(share, chosen, self.family.complete_all)
        self._look(share, chosen, True, self.watching)

    def _change(self, share: Any, chosen: np.ndarray, change: Any) -> None:
        first, last, scenes = share
        state = self.state
        change(
            *scenes, state.ids, state.heads, state.generators, self.template, self.constants,
            *self.behavior, self.now.told.rewards, chosen, first, last,
        )  # fmt: skip

    def _look(
        self, share: Any, chosen: np.ndarray, observing: bool = True, measuring: int = NOTHING
    ) -> None:
        """Observe, and measure, where ``chosen`` [E] says so."""
        if not observing and measuring == NOTHING:
            return
        first, last, scenes = share
        state, seen, told = self.state, self.now.seen, self.now.told
        look_all(
            *scenes, state.ids, state.heads, state.generators, *self.spec, *seen, told.speed,
            told.crashed, *self.measured, chosen, observing, measuring, first, last,
        )  # fmt: skip

    def measure(self, collisions: bool) -> Measured:
        """How the egos are driving; steps and resets see to it from now on."""
        wanted = COLLISIONS if collisions else DRIVING
        if self.watching != wanted:
            self.watching = wanted
            self._share_out(self._look, self.everywhere, False, wanted)
        return self.measured


def _template(traffic: Traffic, capacity: int, ego: Any) -> np.ndarray:
    """Records of a reset to begin with: of all vehicles, then the objects, then scratch.

    Where the ego is not the first, as its number changes, it is the last of the vehicles.
    """
    n, records = traffic.n, traffic.records
    if (place := traffic.controlled(ego)) > 0:
        others = np.repeat(records[place - 1 : place], capacity - 1)
        template = np.concatenate([others, records[place : place + 1], records[n:]])
    else:
        others = np.repeat(records[n - 1 : n], max(capacity - n, 0))
        template = np.concatenate([records[: min(n, capacity)], others, records[n:]])
    template["collects"] = 0
    vehicles = template[:capacity]
    for name in set(STATE_FLOATS + STATE_INTS) - {"target_speed", "lane", "target_lane"}:
        vehicles[name] = 0  # the reset that they were read off may have driven them already
    return template
