"""Drivers that know how to drive without having learned it: a planner, and IDM/MOBIL."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

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

Expert = Literal["planner", "idm"]


def check(expert: Expert, planner: LookAhead, config: TrainConfig) -> None:
    """Raises UserError where the expert cannot drive."""
    if expert == "idm":
        check_env(config)
        make_env(config, rule_driver=True).close()
    else:
        _batch(planner, config, 1).close()


def drive(
    expert: Expert, planner: LookAhead, config: TrainConfig, seeds: Sequence[int],
    stop: Callable[[], bool] = lambda: False,
) -> list[Episode]:  # fmt: skip
    """Episodes of an expert on ``seeds``. planner: with which ``planner`` looks ahead.

    stop: as in ``evaluate``. Raises UserError where the expert cannot drive.
    """
    if expert == "idm":
        return rule_driver(config, seeds, stop)
    envs = _batch(planner, config, min(config.n_envs, len(seeds)))
    with closing(envs):
        return evaluate(envs, lambda observations: planner.actions(envs.envs), seeds, stop)


def film_expert(
    expert: Expert, planner: LookAhead, config: TrainConfig, seed: int, folder: Path
) -> Path:
    """An episode on film: what the planner does in a batch, it does again before the camera."""
    if expert == "idm":
        return film(config, lambda observations: np.zeros(1), seed, folder, rule_driver=True)
    actions: list[Any] = []
    envs = _batch(planner, config, 1)
    with closing(envs):

        def noted(observations: Any) -> Any:
            actions.append(planner.actions(envs.envs))
            return actions[-1]

        evaluate(envs, noted, [seed])
    again = iter(actions)
    return film(config, lambda observations: next(again), seed, folder)


def _batch(planner: LookAhead, config: TrainConfig, count: int) -> BatchVecEnv:
    """Environments that can be copied. Raises UserError where there are none, or nothing to try."""
    check_env(config)
    if reason := unknown_to_engine(config):
        raise UserError(f"planner: {config.env} is not simulated in batches: {reason}")
    envs = BatchVecEnv(config, count, evaluation=True)
    try:
        planner.sequences(envs.envs)
    except ValueError as error:
        envs.close()
        raise UserError(f"planner: {config.env}: {error}") from error
    return envs
