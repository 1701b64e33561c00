"""Who can say what actions are worth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from esc_agents.config import TrainConfig
from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.environments import other_meaning, wrapper_json
from esc_agents.driving.episodes import model_policy
from esc_agents.driving.experts import check_planner, copyable, named
from esc_agents.errors import UserError
from esc_agents.training.evaluation import learned
from esc_agents.training.models import load_model
from esc_agents.training.run_directory import open_run
from esc_gym.adaptation import adapt
from esc_gym.planning import LookAhead, idm_actions, meta_actions

Expert = Callable[[BatchVecEnv, dict[str, NDArray], NDArray], NDArray]
"""(environments, their observations, numbers of K of them) -> values of the actions there, [K, A].

Whoever only acts values the own action at 1, and all others at 0.
"""
RUN = "run:"


def expert_of(name: str, planner: LookAhead, config: TrainConfig, trust: bool = False) -> Expert:
    """The expert called ``name``: planner, idm, or run:DIR.

    planner: with which the first looks ahead. trust: as of ``load_model``. Raises UserError for
    another name, and where an expert cannot drive.
    """
    if name == "planner":
        check_planner(planner, config)
        return lambda envs, observations, chosen: planner.values(envs.envs, chosen)
    if name != "idm" and not name.startswith(RUN):
        raise UserError(f"expert: expected planner, idm or {RUN}DIR, got {name!r}")
    with copyable(name, config) as envs, named(name, config):
        count = len(meta_actions(envs))
    if name == "idm":
        return lambda envs, observations, chosen: np.eye(count)[idm_actions(envs.envs, chosen)]
    return _policy(Path(name.removeprefix(RUN)), config, count, trust)


def _policy(directory: Path, config: TrainConfig, count: int, trust: bool) -> Expert:
    """A trained policy; it has to know what the observations here mean."""
    theirs = open_run(directory, trust).model_copy(update={"device": config.device})
    model, _ = load_model(theirs, directory, trust)
    if getattr(model.action_space, "n", None) != count:
        raise UserError(
            f"{RUN}{directory}: expected a run with the {count} meta-actions of {config.env}, got "
            f"one with the actions {model.action_space}"
        )
    there = learned(directory)
    with copyable(f"{RUN}{directory}", config) as envs:
        what = other_meaning(wrapper_json(envs.engine.env), there)
    if what:
        raise UserError(f"{RUN}{directory}: expected a run with the same observation, got {what}")
    policy = model_policy(model)

    def values(envs: BatchVecEnv, observations: dict[str, NDArray], chosen: NDArray) -> NDArray:
        adapt(getattr(model, "policy", model), envs)
        return np.eye(count)[policy({name: part[chosen] for name, part in observations.items()})]

    return values
