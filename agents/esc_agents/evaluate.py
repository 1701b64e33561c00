"""Drive fixed seeds with a policy and say how it went; the blind baselines of a scenario."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import inf
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from esc_agents.errors import UserError
from esc_agents.statistics import mean_interval, wilson_interval

Policy = Callable[[dict[str, NDArray]], NDArray]
"""Observations of a batch of environments -> one action each."""


@dataclass(frozen=True)
class Episode:
    """One evaluated drive.

    seed of the environment; reward: the return; length [policy steps]; speed: mean [m/s];
    progress: way made along the lanes [m]; off_road: share of the steps; vehicles: mean size M of
    the set; min_ttc: least time to collision [s], inf for none.
    """

    seed: int
    reward: float
    length: int
    crashed: bool
    speed: float
    progress: float
    off_road: float
    lane_changes: int
    vehicles: float
    min_ttc: float


MEANS = ("speed", "progress", "off_road", "length", "lane_changes", "vehicles")


@dataclass(frozen=True)
class Summary:
    """Means over episodes; intervals are 95 % (Student's t; Wilson for the collision rate)."""

    episodes: int
    reward: float
    reward_low: float
    reward_high: float
    collision_rate: float
    collision_low: float
    collision_high: float
    speed: float
    progress: float
    off_road: float
    length: float
    lane_changes: float
    vehicles: float
    min_ttc: float

    @classmethod
    def of(cls, episodes: Sequence[Episode]) -> Summary:
        """min_ttc is the median over episodes: it may be infinite in some."""
        crashes = sum(episode.crashed for episode in episodes)

        def mean(name: str) -> float:
            return float(np.mean([getattr(episode, name) for episode in episodes]))

        return cls(
            len(episodes),
            *mean_interval([episode.reward for episode in episodes]),
            crashes / len(episodes),
            *wilson_interval(crashes, len(episodes)),
            *map(mean, MEANS),
            min_ttc=float(np.median([episode.min_ttc for episode in episodes])),
        )


def evaluate(
    envs: VecEnv,
    policy: Policy,
    seeds: Sequence[int],
    stop: Callable[[], bool] = lambda: False,
) -> list[Episode]:
    """One episode per seed, in the order of ``seeds``, shared out among ``envs``.

    envs: vectorised ``make_env(..., evaluation=True)``. stop: asked before each step; once true,
    the episodes that have ended by then are returned.
    """
    for index in range(envs.num_envs):
        envs.env_method("set_seeds", list(seeds[index :: envs.num_envs]), indices=index)
    observations: Any = envs.reset()
    ended: dict[int, Episode] = {}
    while len(ended) < len(seeds) and not stop():
        observations, _, _, infos = envs.step(policy(observations))
        check_faults(infos)
        for info in infos:
            if episode := info.get("episode"):
                ended[episode["seed"]] = _episode(episode)
    return [ended[seed] for seed in seeds if seed in ended]


def check_faults(infos: Sequence[dict[str, Any]], where: str = "evaluation") -> None:
    """Raises UserError where an environment (``esc_agents.envs.Worker``) reports a fault."""
    for index, info in enumerate(infos):
        if fault := info.get("fault"):
            raise UserError(f"{where}, environment {index}, {fault}")


def _episode(info: dict[str, Any]) -> Episode:
    return Episode(
        reward=info["r"], length=info["l"], crashed=bool(info["crashed"]),
        **{name: info[name] for name in ("seed", *MEANS, "min_ttc") if name != "length"},
    )  # fmt: skip


def read_evaluations(path: Path) -> dict[str, NDArray]:
    """The arrays of an evaluations.npz, each as long as ``timesteps``. Raises UserError."""
    try:
        with path.open("rb") as file, np.load(file) as saved:
            arrays = {name: saved[name] for name in saved.files}
        lengths = {len(values) for values in arrays.values()}
        if lengths != {len(arrays["timesteps"])}:
            raise ValueError(f"arrays of different lengths, {sorted(lengths)}")
        return arrays
    except FileNotFoundError:
        raise
    except Exception as error:  # a damaged archive makes NumPy raise almost anything
        raise UserError(f"{path} is damaged: {type(error).__name__}: {error}") from error


def model_policy(model: Any) -> Policy:
    """The deterministic policy of an SB3 model."""
    return lambda observations: model.predict(observations, deterministic=True)[0]


def blind_policies(
    space: gym.Space, count: int, names: Mapping[int, str], seed: int
) -> dict[str, Policy]:
    """Every policy that does not look: each constant action, and a random one.

    space: of one environment; count: of environments; names: of discrete actions. Of continuous
    actions: the neutral one, and full throttle straight ahead where there is a throttle.
    """
    if isinstance(space, gym.spaces.Discrete):
        constants: dict[str, Any] = {
            f"always {names.get(action, action)}": action for action in range(int(space.n))
        }
    else:
        neutral = np.zeros(space.shape or (), np.float32)
        constants = {"always neutral": neutral}
        if neutral.size == 2:
            constants["always full throttle"] = np.array([1, 0], np.float32)
    policies = {name: _constant(action, count) for name, action in constants.items()}
    return policies | {"random": _random(space, count, seed)}


def _constant(action: Any, count: int) -> Policy:
    actions = np.array([action] * count)
    return lambda observations: actions


def _random(space: gym.Space, count: int, seed: int) -> Policy:
    generator = np.random.default_rng(seed)
    if isinstance(space, gym.spaces.Discrete):
        return lambda observations: generator.integers(space.n, size=count)
    shape = (count, *(space.shape or ()))
    return lambda observations: generator.uniform(-1, 1, shape).astype(np.float32)


def as_rows(results: dict[str, Summary]) -> list[dict[str, Any]]:
    """Results by policy as plain rows, for JSON."""
    return [{"policy": name, **asdict(summary)} for name, summary in results.items()]


def summaries(rows: Sequence[dict[str, Any]]) -> dict[str, Summary]:
    """``as_rows`` back; JSON has null for no time to collision."""
    values: list[Any] = [{k: inf if v is None else v for k, v in row.items()} for row in rows]
    return {row.pop("policy"): Summary(**row) for row in values}
