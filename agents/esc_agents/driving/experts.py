"""Drivers that know how to drive without having learned it: a planner, and IDM/MOBIL."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from esc_agents.config import TrainConfig
from esc_agents.driving.baselines import rule_driver
from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.checks import check_env
from esc_agents.driving.environments import make_env
from esc_agents.driving.episodes import Episode, evaluate
from esc_agents.driving.films import film
from esc_agents.driving.planner_config import PlannerConfig
from esc_agents.driving.planners import make_planner
from esc_agents.driving.vectorised import closing
from esc_agents.errors import UserError
from esc_gym.planning import LookAhead, Planner

PLANNER = "planner, knows all"
"""What tables call ``reference_planner``."""


def check_rule(config: TrainConfig) -> None:
    """Raises UserError where IDM/MOBIL cannot drive."""
    check_env(config)
    make_env(config, rule_driver=True).close()


def drive(
    planner: Planner | None, config: TrainConfig, seeds: Sequence[int],
    stop: Callable[[], bool] = lambda: False,
) -> list[Episode]:  # fmt: skip
    """Episodes of an expert on ``seeds``. planner: who drives, None: IDM/MOBIL.

    stop: as in ``evaluate``.
    """
    if planner is None:
        return rule_driver(config, seeds, stop)
    envs = BatchVecEnv(config, min(config.n_envs, len(seeds)), evaluation=True)
    with closing(envs):
        return evaluate(envs, lambda observations: planner.actions(envs.envs), seeds, stop)


def reference_planner(
    config: TrainConfig, seeds: Sequence[int], stop: Callable[[], bool] = lambda: False
) -> list[Episode]:
    """Episodes of the planner that tables list, ``LookAhead(free=1)``: what can be had by who knows
    all. stop: as in ``evaluate``. Raises UserError where it cannot plan, or would take hours."""
    planner = make_planner(PlannerConfig(), config, free=1)
    if not isinstance(planner, LookAhead):
        raise UserError("continuous actions take it long; see esc-eval --expert planner")
    return drive(planner, config, seeds, stop)


def film_expert(planner: Planner | None, config: TrainConfig, seed: int, folder: Path) -> Path:
    """An episode on film: what the planner does in a batch, it does again before the camera."""
    if planner is None:
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
