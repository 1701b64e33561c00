"""esc-bench's work: how fast the accelerated environments are, and whether they drive the same.

Stock highway-env and ours take turns, an episode each, on the same seeds and actions, so that a
noisy machine hits both alike. A first round, not timed, compares every step; the others compare how
each episode ends.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from numpy.typing import NDArray

import esc_gym
from esc_agents import files
from esc_agents.config import config_for_env
from esc_agents.driving.environments import named_version
from esc_agents.errors import UserError, say
from esc_agents.proof import end_to_end as training, planning as plans, scaling
from esc_agents.proof.timing import cpu, in_own_process, milliseconds, ratio
from esc_agents.reporting.tables import markdown, show, terminal
from esc_gym import fastsim
from esc_gym.fastsim.behavior import original_behavior
from esc_gym.registration import HIGHWAY_ENV_IDS, MULTI_AGENT_IDS, NAMESPACE

STEPS = 20  # of an episode at most
ROUNDS = 2  # at least
END_TO_END = ("highway-v0", "highway-fast-v0")
NOISY = ("lane-keeping-v0",)  # the stock observation draws from the environment's generator
MARKERS = ("<!-- esc-bench -->", "<!-- /esc-bench -->")
SPEED_COLUMNS = (
    "environment", "stock ms/step", "accelerated ms/step", "ratio", "stock ms/reset",
    "accelerated ms/reset", "compiled steps", "trajectories",
)  # fmt: skip
SPEED_TEXT = f"""## Simulation and observation

One `env.step`, one `env.reset`. Stock: `gym.make(id)`. Accelerated: `gym.make("esc_gym/" + id)`,
set observation included; with an asterisk, `esc_gym.accelerate(gym.make(id))` and highway-env's own
observation. Each id has a process of its own, in which the two take turns of an episode of at most
{STEPS} steps, on the same seeds and random actions; of several rounds the fastest mean of each
counts. Reward, end, random generator and position, heading, speed, lane and crash of every vehicle
are compared, to the last bit: after every step in a first round, which is not timed, and at the end
of each episode in the others. (Not the generator in {", ".join(NOISY)}: its stock observation draws
noise from it.)
"""


def benchmark(
    envs: Sequence[str], seeds: int, seconds: float, batch: bool, end_to_end: bool, planning: bool,
    out: Path | None, readme: Path | None, command: str,
) -> bool:  # fmt: skip
    """Measure ``envs``, print the tables and write the files; true if all drive the same."""
    ids = check_ids(envs)
    trained = _among(ids, END_TO_END, "--end-to-end") if end_to_end else []
    planned = _among(ids, plans.IDS, "--planning") if planning else []
    if readme:
        replace_block(readme, "")  # raises now rather than after minutes
    if out:
        make_folder(out)
    speeds = []
    for number, id in enumerate(ids, 1):
        speeds.append(in_own_process(measure, id, seeds, seconds))
        _, stock, ours, times, *_, same = speeds[-1].cells()
        say(f"[{number}/{len(ids)}] {id}: {stock} -> {ours} ms/step, {times}; {same}")
    steps = [SPEED_COLUMNS, *(speed.cells() for speed in speeds)]
    show(terminal(steps, "Simulation and observation (*: highway-env's own)"))
    stamp = [time.strftime("%Y-%m-%d"), cpu(), *map(" ".join, files.versions().items())]
    text = ["# Speed\n", f"Written by `{command}`: {', '.join(stamp)}.\n"]
    text += [SPEED_TEXT, markdown(steps)]
    blocks = [markdown([row[:4] for row in steps if row is SPEED_COLUMNS or "-v0" in row[0]])]
    if batch and (alone := [id for id in ids if id not in MULTI_AGENT_IDS]):
        rows = scaling.rows(alone, seconds, say)
        show(terminal(rows, "Batches"))
        text += ["\n" + scaling.TEXT, markdown(rows)]
        blocks.append(markdown([r for r in rows if r is scaling.COLUMNS or "-v0" in r[0]]))
        if out:
            text.append("\n" + scaling.growth_text(seconds, out, say))
    if planned:
        rows = [plans.COLUMNS, *(in_own_process(plans.measure, id, seconds) for id in planned)]
        show(terminal(rows, "Planning"))
        text += ["\n" + plans.TEXT, markdown(rows)]
    if trained:
        rows = [training.COLUMNS]
        rows += [training.measure(config_for_env(id), seconds, say) for id in trained]
        show(terminal(rows, "PPO training"))
        text += ["\n" + training.TEXT, markdown(rows)]
    if out:
        files.write_text(out, "\n".join(text) + "\n")
        say(f"Written: {out}")
    if readme:
        blocks.append(f"`esc-bench` on {cpu()}; with \\*, highway-env's observation.")
        block = "\n\n".join(blocks)
        files.write_text(readme, replace_block(readme, block))
        say(f"Written: {readme}")
    return not any(speed.differences for speed in speeds)


def _among(ids: Sequence[str], wanted: Sequence[str], flag: str) -> list[str]:
    """Those that are wanted; raises UserError for none, on behalf of ``flag``."""
    found = [id for id in ids if id in wanted]
    if not found:
        raise UserError(f"{flag}: expected {' or '.join(wanted)} among --envs")
    return found


def check_ids(envs: Sequence[str]) -> list[str]:
    """The ids, each once; raises UserError for one that is not highway-env's."""
    ids = [env.removeprefix(f"{NAMESPACE}/") for env in envs]
    for id in ids:
        if id not in HIGHWAY_ENV_IDS:
            near = get_close_matches(id, HIGHWAY_ENV_IDS, 1) or ["highway-v0"]
            raise UserError(f"--envs: expected highway-env ids, got {id!r}; try {near[0]!r}")
    if not ids:
        raise UserError("--envs: expected at least one highway-env id, got none")
    return list(dict.fromkeys(ids))


@dataclass(frozen=True)
class Speed:
    """One id. stock, ours: seconds of a step and of a reset; compiled: share of our steps;
    differences: of the trajectories, the first one by seed."""

    id: str
    stock: tuple[float, float]
    ours: tuple[float, float]
    compiled: float
    seeds: int
    differences: dict[int, str]

    def cells(self) -> list[str]:
        """The row of the table."""
        name = f"{self.id} *" if self.id in MULTI_AGENT_IDS else self.id
        found = [f"seed {seed} differs: {what}" for seed, what in self.differences.items()]
        same = "; ".join(found) or f"{self.seeds} seed{'s' * (self.seeds > 1)}, all equal"
        steps, resets = zip(self.stock, self.ours, strict=True)
        cells = [*map(milliseconds, steps), ratio(*steps), *map(milliseconds, resets)]
        return [name, *cells, f"{self.compiled:.0%}", same]


def measure(id: str, seeds: int, seconds: float) -> Speed:
    """Race the two sides of an id for about ``seconds``, on ``seeds`` episodes a round."""
    make = partial(gym.make, disable_env_checker=True)
    # intersection-v0 writes class attributes: they last for its own measurement, not for others.
    with original_behavior(IDMVehicle), named_version():
        alone = id not in MULTI_AGENT_IDS
        ours = Side(make(f"{NAMESPACE}/{id}") if alone else esc_gym.accelerate(make(id)))
        stock = Side(make(id))
        try:
            ignored = GENERATOR if id in NOISY else ""
            (stock_best, best), differences = race(stock, ours, range(seeds), seconds, ignored)
            counts = fastsim.report(ours.env)
        finally:
            stock.env.close()
            ours.env.close()
    compiled = counts.compiled / max(1, counts.compiled + sum(counts.stock.values()))
    return Speed(id, tuple(stock_best), tuple(best), compiled, seeds, differences)


State = dict[str, Any]
GENERATOR = "random generator"


class Side:
    """One contender: an environment, and the seconds that its steps and resets have taken."""

    def __init__(self, env: gym.Env) -> None:
        self.env = env
        self.steps: list[float] = []
        self.resets: list[float] = []

    def drive(self, seed: int, actions: Sequence[Any], watch: bool) -> dict[int, State]:
        """Reset, and step until the episode or ``actions`` end: the last state, by its step.

        watch: the states after the reset (0) and after every step.
        """
        before = time.perf_counter()
        self.env.reset(seed=seed)
        self.resets.append(time.perf_counter() - before)
        states = {0: state(self.env)} if watch else {}
        for step, action in enumerate(actions, 1):
            before = time.perf_counter()
            _, reward, terminated, truncated, _ = self.env.step(action)
            self.steps.append(time.perf_counter() - before)
            ended = np.all(terminated) or truncated or step == len(actions)  # of several a tuple
            if watch or ended:
                states[step] = state(self.env, reward, terminated, truncated)
            if ended:
                break
        return states

    def end_round(self) -> tuple[float, float]:
        """Mean seconds of a step and of a reset since the last call."""
        means = float(np.mean(self.steps)), float(np.mean(self.resets))
        self.steps, self.resets = [], []
        return means


def state(env: gym.Env, reward: Any = 0, terminated: Any = False, truncated: Any = False) -> State:
    """What must be equal on both sides; numbers as the bytes of their float64."""
    base: Any = env.unwrapped
    names: State = {GENERATOR: base.np_random.bit_generator.state}
    numbers = {"reward": reward, "terminated": terminated, "truncated": truncated}
    for index, vehicle in enumerate(base.road.vehicles):
        names[f"lane_index of vehicle {index}"] = np.array(vehicle.lane_index, str).tolist()
        for name in ("position", "heading", "speed", "crashed"):
            numbers[f"{name} of vehicle {index}"] = getattr(vehicle, name)
    return names | {name: np.array(number, float).tobytes() for name, number in numbers.items()}


def race(
    stock: Side, ours: Side, seeds: Sequence[int], seconds: float, ignored: str = ""
) -> tuple[NDArray, dict[int, str]]:
    """Drive rounds of all ``seeds`` in turns: best means [side, (step, reset)], and differences."""
    drives = {seed: draw_actions(stock.env.action_space, seed) for seed in seeds}
    differences: dict[int, str] = {}
    rounds: list[Any] = []

    def drive_all(watch: bool = False) -> None:
        for seed, actions in drives.items():
            expected, got = (side.drive(seed, actions, watch) for side in (stock, ours))
            if found := difference(expected, got, ignored):
                differences.setdefault(seed, found)
        rounds.append((stock.end_round(), ours.end_round()))

    drive_all(watch=True)
    rounds.clear()  # also not timed: compilers and caches have started
    deadline = time.perf_counter() + seconds
    while len(rounds) < ROUNDS or time.perf_counter() < deadline:
        drive_all()
    return np.min(rounds, axis=0), differences


def draw_actions(space: gym.Space, seed: int) -> list[Any]:
    """Random actions; with odd seeds throttle and steering are gentle, to stay on the road."""
    space = deepcopy(space)  # highway-env draws from its own
    space.seed(seed)
    drawn = [space.sample() for _ in range(STEPS)]
    gentle = isinstance(space, gym.spaces.Box) and seed % 2
    return [np.float32(0.05) * action for action in drawn] if gentle else drawn


def difference(
    stock: Mapping[int, State], ours: Mapping[int, State], ignored: str = ""
) -> str | None:
    """When two drives first differ, and in what, unless ``ignored``; None if they do not."""
    for step in sorted({*stock, *ours}):
        a, b = stock.get(step, {}), ours.get(step, {})
        for name in a | b:
            if name != ignored and a.get(name) != b.get(name):
                return f"{name}, step {step}"
    return None


def make_folder(path: Path) -> None:
    """The folder of a file to write; raises UserError where it could not be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {path}: {error.strerror}") from error
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise UserError(f"--out: expected a file that can be written, got {path}")


def replace_block(path: Path, block: str) -> str:
    """The file's text with ``block`` between the markers; or UserError."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"--readme {path}: {error.strerror}") from error
    before, opening, rest = text.partition(MARKERS[0])
    _, closing, after = rest.partition(MARKERS[1])
    if not closing:
        raise UserError(f"--readme {path}: expected {' and, below it, '.join(MARKERS)} in it")
    return f"{before}{opening}\n{block}\n{closing}{after}"
