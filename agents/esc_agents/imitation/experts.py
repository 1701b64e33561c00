"""Who can say what actions are worth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from esc_agents.config import TrainConfig
from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.planner_config import PlannerConfig
from esc_agents.driving.planners import copyable, driver_of, make_planner, named
from esc_agents.errors import UserError
from esc_gym.planning import MetaPlanner, idm_actions, meta_actions

Expert = Callable[[BatchVecEnv, dict[str, NDArray], NDArray], NDArray]
"""(environments, their observations, numbers of K of them) -> values of the actions there, [K, A].

Whoever only acts values the own action at 1, and all others at 0.
"""
RUN = "run:"


def expert_of(
    name: str, look_ahead: PlannerConfig, config: TrainConfig, trust: bool = False, **defaults: Any
) -> Expert:
    """The expert called ``name``: planner, idm, or run:DIR.

    look_ahead, defaults: how the first does. trust: as of ``load_policy``. Raises UserError for
    another name, and where an expert cannot drive.
    """
    if name == "planner":
        if look_ahead.milliseconds is not None:
            raise UserError("--planner.milliseconds: labels must not depend on the machine")
        planner = make_planner(look_ahead, config, trust, **defaults)
        if not isinstance(planner, MetaPlanner):
            raise UserError(
                f"planner: expected meta-actions, whose values it says, got the continuous actions "
                f"of {config.env}, with which only esc-eval --expert planner drives"
            )
        return lambda envs, observations, chosen: planner.values(envs.envs, chosen)
    if name != "idm" and not name.startswith(RUN):
        raise UserError(f"expert: expected planner, idm, {RUN}DIR or {RUN}zoo:NAME, got {name!r}")
    if look_ahead != PlannerConfig():
        raise UserError(f"--planner: expected --expert planner beside it, got --expert {name}")
    with copyable(name, config) as envs, named(name, config):
        count = len(meta_actions(envs))
        if name == "idm":
            return lambda envs, observations, chosen: np.eye(count)[idm_actions(envs.envs, chosen)]
        drive = driver_of(name.removeprefix(RUN), config, envs, trust)

    def values(envs: BatchVecEnv, observations: dict[str, NDArray], chosen: NDArray) -> NDArray:
        return np.eye(count)[drive({name: part[chosen] for name, part in observations.items()})]

    return values
