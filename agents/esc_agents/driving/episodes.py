"""Drive fixed seeds with a policy and say how it went."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from math import inf, isinf
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from esc_agents.config import TrainConfig
from esc_agents.errors import UserError
from esc_agents.reporting.statistics import mean_interval, wilson_interval

Policy = Callable[[dict[str, NDArray]], NDArray]
"""Observations of a batch of environments -> one action each."""


@dataclass(frozen=True)
class Episode:
    """One evaluated drive.

    seed of the environment; reward: the return; length [policy steps]; speed: mean [m/s];
    progress: way made along the lanes [m]; off_road: share of the steps; vehicles: mean size M of
    the set; min_ttc: least time to collision [s], inf for none; arrived: at the exit, the parking
    spot or behind the intersection, None where there is nothing to arrive at.
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
    arrived: bool | None = None


COLUMNS = ("policy", "return", "collisions", "speed m/s", "steps", "lane changes", "min TTC s")
MEANS = ("speed", "progress", "off_road", "length", "lane_changes", "vehicles")


@dataclass(frozen=True)
class Summary:
    """Means over episodes; intervals are 95 % (Student's t; Wilson for the collision rate).

    arrived: share of the episodes, None where there is nothing to arrive at.
    """

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
    arrived: float | None = None

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
            arrived=None if episodes[0].arrived is None else mean("arrived"),
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
                ended[episode["seed"]] = _episode(episode, _arrived(info))
    return [ended[seed] for seed in seeds if seed in ended]


def check_faults(infos: Sequence[dict[str, Any]], where: str = "evaluation") -> None:
    """Raises UserError where an environment (``wrappers.Worker``) reports a fault."""
    for index, info in enumerate(infos):
        if fault := info.get("fault"):
            raise UserError(f"{where}, environment {index}, {fault}")


def _arrived(info: dict[str, Any]) -> bool | None:
    """What the last info of an episode says of it, by the names that highway-env has for it."""
    arrived = info.get("is_success", info.get("rewards", {}).get("arrived_reward"))
    return None if arrived is None else bool(arrived)


def _episode(info: dict[str, Any], arrived: bool | None) -> Episode:
    return Episode(
        reward=info["r"], length=info["l"], crashed=bool(info["crashed"]), arrived=arrived,
        **{name: info[name] for name in ("seed", *MEANS, "min_ttc") if name != "length"},
    )  # fmt: skip


def seeds(config: TrainConfig) -> range:
    """Seeds of the evaluation's episodes."""
    return range(config.evaluation.seed, config.evaluation.seed + config.evaluation.episodes)


def model_policy(model: Any) -> Policy:
    """The deterministic policy of an SB3 model."""
    return lambda observations: model.predict(observations, deterministic=True)[0]


def as_rows(results: dict[str, Summary]) -> list[dict[str, Any]]:
    """Results by policy as plain rows, for JSON."""
    return [{"policy": name, **asdict(summary)} for name, summary in results.items()]


def summaries(rows: Sequence[dict[str, Any]]) -> dict[str, Summary]:
    """``as_rows`` back; JSON has null for no time to collision."""
    values: list[Any] = [
        {**row, "min_ttc": inf if row["min_ttc"] is None else row["min_ttc"]} for row in rows
    ]
    return {row.pop("policy"): Summary(**row) for row in values}


def table(results: dict[str, Summary]) -> list[Sequence[str]]:
    """A header and a row for each policy, for people; brackets hold 95 % intervals."""
    rows = [list(COLUMNS), *(_cells(name, summary) for name, summary in results.items())]
    if any(summary.arrived is not None for summary in results.values()):
        shares = [None if s.arrived is None else f"{s.arrived:.0%}" for s in results.values()]
        for row, cell in zip(rows, ["arrived", *shares], strict=True):
            row.insert(3, cell or "")
    return rows  # type: ignore[return-value]


def return_of(summary: Summary) -> str:
    """The mean return and its interval."""
    return f"{summary.reward:.2f} [{summary.reward_low:.2f}, {summary.reward_high:.2f}]"


def _cells(name: str, s: Summary) -> list[str]:
    return [
        name,
        return_of(s),
        f"{s.collision_rate:.0%} [{s.collision_low:.0%}, {s.collision_high:.0%}]",
        f"{s.speed:.1f}",
        f"{s.length:.1f}",
        f"{s.lane_changes:.1f}",
        "none" if isinf(s.min_ttc) else f"{s.min_ttc:.1f}",
    ]
