"""Episodes in which an expert said of every step what each action would have been worth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from esc_agents import files
from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.episodes import Policy, check_faults
from esc_agents.errors import UserError
from esc_agents.imitation.experts import Expert
from esc_gym.planning import best, meta_actions

HELD_OUT = 10  # every tenth episode


@dataclass(frozen=True)
class Drive:
    """An episode of T steps.

    observations: by name [T + 1, ...], the last one of its end. actions [T]: what was done.
    values [T, A]: what the expert thought of each action. rewards [T]. terminated: it ended by
    itself, and was not cut short.
    """

    seed: int
    observations: dict[str, NDArray]
    actions: NDArray
    values: NDArray
    rewards: NDArray
    terminated: bool


@dataclass(frozen=True)
class Labels:
    """What one learns from: observations, by name [K, ...], and the values of actions [K, A]."""

    observations: dict[str, NDArray]
    values: NDArray

    @classmethod
    def of(cls, drives: Sequence[Drive]) -> Labels:
        observations = {
            name: np.concatenate([drive.observations[name][:-1] for drive in drives])
            for name in drives[0].observations
        }
        return cls(observations, np.concatenate([drive.values for drive in drives]))

    def __len__(self) -> int:
        return len(self.values)


def split(drives: Sequence[Drive]) -> tuple[list[Drive], list[Drive]]:
    """(to learn from, held out): whole episodes, since steps of one resemble each other.

    Every tenth is held out, and of fewer than ten the last one.
    """
    every = min(HELD_OUT, len(drives))
    held = [i % every == every - 1 for i in range(len(drives))]
    return (
        [drive for drive, out in zip(drives, held, strict=True) if not out],
        [drive for drive, out in zip(drives, held, strict=True) if out],
    )


def collect(
    envs: BatchVecEnv, seeds: Sequence[int], expert: Expert, learner: Policy | None, noise: float,
    generator: np.random.Generator, stop: Callable[[], bool] = lambda: False,
) -> list[Drive]:  # fmt: skip
    """An episode of each seed, in their order, labelled by ``expert``.

    envs: for evaluation. learner: who drives, None: the expert itself. noise: share of the steps in
    which a random action is taken, drawn from ``generator``. stop: asked before each step; once
    true, the episodes that have ended are returned.
    """
    count, numbers = envs.num_envs, meta_actions(envs.envs)
    for e in range(count):
        envs.env_method("set_seeds", list(seeds[e::count]), indices=e)
    observations: dict[str, NDArray] = envs.reset()
    begun: list[list[tuple[Any, ...]]] = [[] for _ in range(count)]
    ended: dict[int, Drive] = {}
    while len(ended) < len(seeds) and not stop():
        driving = np.flatnonzero(~envs.resting)
        values = np.zeros((count, len(numbers)), np.float32)
        values[driving] = expert(envs, observations, driving)
        actions = learner(observations) if learner else best(values, numbers)
        random = generator.integers(len(numbers), size=count)
        actions = np.where(generator.random(count) < noise, random, actions)
        after: Any
        after, rewards, dones, infos = envs.step(actions)
        check_faults(infos, "collecting")
        for e in driving.tolist():
            seen = {name: part[e] for name, part in observations.items()}
            begun[e].append((seen, actions[e], values[e], rewards[e]))
            if dones[e]:
                seed = infos[e]["episode"]["seed"]
                ended[seed] = _drive(seed, begun[e], infos[e])
                begun[e] = []
        observations = after
    return [ended[seed] for seed in seeds if seed in ended]


def _drive(seed: int, steps: list[tuple[Any, ...]], info: dict[str, Any]) -> Drive:
    seen, actions, values, rewards = zip(*steps, strict=True)
    last = info["terminal_observation"]
    return Drive(
        seed,
        {name: np.stack([*(each[name] for each in seen), last[name]]) for name in last},
        np.array(actions, np.int64), np.array(values), np.array(rewards, np.float32),
        not info["TimeLimit.truncated"],
    )  # fmt: skip


def save(path: Path, drives: Sequence[Drive]) -> None:
    """Write episodes as one NumPy archive, at once."""
    names = list(drives[0].observations)
    arrays: dict[str, Any] = {
        "seeds": np.array([drive.seed for drive in drives]),
        "lengths": np.array([len(drive.actions) for drive in drives]),
        "terminated": np.array([drive.terminated for drive in drives]),
        **{name: np.concatenate([getattr(drive, name) for drive in drives]) for name in COLUMNS},
        **{f"observations/{name}": np.concatenate([d.observations[name] for d in drives])
           for name in names},
    }  # fmt: skip
    files.write_atomically(path, lambda file: np.savez(file, **arrays))


COLUMNS = ("actions", "values", "rewards")


def load(path: Path) -> list[Drive]:
    """What ``save`` wrote. Raises UserError where it is damaged."""
    try:
        with path.open("rb") as file, np.load(file) as saved:
            arrays = {name: saved[name] for name in saved.files}
        lengths = arrays["lengths"]
        ends = np.cumsum(lengths)[:-1]
        columns = {name: np.split(arrays[name], ends) for name in COLUMNS}
        seen = {
            name.partition("/")[2]: np.split(array, np.cumsum(lengths + 1)[:-1])
            for name, array in arrays.items() if name.startswith("observations/")
        }  # fmt: skip
        return [
            Drive(
                int(seed), {name: parts[i] for name, parts in seen.items()},
                terminated=bool(arrays["terminated"][i]),
                **{name: columns[name][i] for name in COLUMNS},
            )
            for i, seed in enumerate(arrays["seeds"])
        ]  # fmt: skip
    except Exception as error:  # a damaged archive makes NumPy raise almost anything
        raise UserError(
            f"{path} is damaged ({type(error).__name__}: {error}); remove it, and it is made anew"
        ) from error
