"""Drivers that know how to drive without having learned it: a planner, and IDM/MOBIL."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from esc_agents.config import TrainConfig
from esc_agents.driving.baselines import rule_driver
from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.checks import check_env
from esc_agents.driving.environments import make_env
from esc_agents.driving.episodes import Episode, evaluate
from esc_agents.driving.films import film
from esc_agents.driving.vectorised import closing, unknown_to_engine
from esc_agents.errors import UserError
from esc_gym.planning import LookAhead
from esc_gym.vector.environment import SetVectorEnv

Expert = Literal["planner", "idm"]


def check(expert: Expert, planner: LookAhead, config: TrainConfig) -> None:
    """Raises UserError where the expert cannot drive."""
    if expert == "idm":
        check_env(config)
        make_env(config, rule_driver=True).close()
    else:
        check_planner(planner, config)


def drive(
    expert: Expert, planner: LookAhead, config: TrainConfig, seeds: Sequence[int],
    stop: Callable[[], bool] = lambda: False,
) -> list[Episode]:  # fmt: skip
    """Episodes of an expert on ``seeds``. planner: with which ``planner`` looks ahead.

    stop: as in ``evaluate``. Raises UserError where the expert cannot drive.
    """
    if expert == "idm":
        return rule_driver(config, seeds, stop)
    envs = BatchVecEnv(config, min(config.n_envs, len(seeds)), evaluation=True)
    with closing(envs):
        return evaluate(envs, lambda observations: planner.actions(envs.envs), seeds, stop)


def film_expert(
    expert: Expert, planner: LookAhead, config: TrainConfig, seed: int, folder: Path
) -> Path:
    """An episode on film: what the planner does in a batch, it does again before the camera."""
    if expert == "idm":
        return film(config, lambda observations: np.zeros(1), seed, folder, rule_driver=True)
    actions: list[Any] = []
    envs = BatchVecEnv(config, 1, evaluation=True)
    with closing(envs):

        def noted(observations: Any) -> Any:
            actions.append(planner.actions(envs.envs))
            return actions[-1]

        evaluate(envs, noted, [seed])
    again = iter(actions)
    return film(config, lambda observations: next(again), seed, folder)


def check_planner(planner: LookAhead, config: TrainConfig) -> None:
    """Raises UserError where there is nothing to plan with ``planner``."""
    with copyable("planner", config) as envs, named("planner", config):
        planner.sequences(envs)


@contextmanager
def copyable(expert: str, config: TrainConfig) -> Iterator[SetVectorEnv]:
    """An environment that can be copied. Raises UserError, on behalf of ``expert``, for none."""
    check_env(config)
    if reason := unknown_to_engine(config):
        raise UserError(f"{expert}: {config.env} is not simulated in batches: {reason}")
    with closing(BatchVecEnv(config, 1)) as envs:
        yield cast(BatchVecEnv, envs).envs


@contextmanager
def named(expert: str, config: TrainConfig) -> Iterator[None]:
    """What an expert cannot do, as a UserError."""
    try:
        yield
    except ValueError as error:
        raise UserError(f"{expert}: {config.env}: {error}") from error
