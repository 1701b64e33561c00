"""Planners as a configuration says, and in which scenarios they can plan."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from typing import Any, cast

import gymnasium as gym
import torch

from esc_agents.config import TrainConfig
from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.checks import check_env
from esc_agents.driving.environments import wrapper_json
from esc_agents.driving.episodes import Policy, model_policy
from esc_agents.driving.planner_config import Method, PlannerConfig
from esc_agents.driving.policies import load_driver
from esc_agents.driving.vectorised import closing, unknown_to_engine
from esc_agents.errors import UserError
from esc_gym.adaptation import adapt
from esc_gym.planning import CrossEntropy, LookAhead, Planner, TreeSearch
from esc_gym.vector.environment import SetVectorEnv

METHODS: dict[Method, type[Planner]] = {
    "look-ahead": LookAhead, "tree": TreeSearch, "cross-entropy": CrossEntropy,
}  # fmt: skip
TITLES: dict[type[Planner], str] = {
    LookAhead: "planner", TreeSearch: "tree search", CrossEntropy: "cross-entropy method",
}  # fmt: skip
ALL = ("all",)


def make_planner(
    config: PlannerConfig, run: TrainConfig, trust: bool = False, **defaults: Any
) -> Planner:
    """The planner for a scenario. trust: as of ``load_policy``. defaults: where nothing is given.

    Raises UserError where there is nothing to plan, or its numbers do not go together.
    """
    with copyable("planner", run) as envs:
        continuous = isinstance(envs.single_action_space, gym.spaces.Box)
        method = config.method or ("cross-entropy" if continuous else "look-ahead")
        kind = METHODS[method]
        has = {field.name for field in fields(kind)}
        given: dict[str, Any] = config.model_dump(exclude={"method"}, exclude_none=True)
        if foreign := sorted(given.keys() - has):
            raise UserError(f"--planner.{foreign[0]}: the method {method} has none; leave it out")
        values = {name: value for name, value in defaults.items() if name in has} | given
        if values.get("continuations") == ALL:
            values["continuations"] = None
        if config.policy:
            values["policy"] = driver_of(config.policy, run, envs, trust)
        try:
            planner = kind(**values)
        except ValueError as error:
            raise UserError(f"--planner.{error}") from error
        with named("planner", run):
            planner.check(envs)
        return planner


def driver_of(source: str, run: TrainConfig, envs: SetVectorEnv, trust: bool = False) -> Policy:
    """How a trained policy drives in the environments of ``run``.

    source: its run directory, or zoo:NAME. Raises UserError where it would not know what it sees,
    or what it does.
    """
    torch.set_num_threads(run.threads)
    policy = load_driver(source, wrapper_json(envs.engine.env), envs.single_action_space, trust)
    with named(source, run):
        adapt(policy, cast(Any, envs.engine.env))
    return model_policy(policy)


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
