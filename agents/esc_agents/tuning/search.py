"""Which settings are tried next: Optuna's part of a search."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import optuna
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.trial import FrozenTrial, TrialState, create_trial

from esc_agents.errors import UserError
from esc_agents.tuning.settings import Parameters, TuneConfig, scenario, train_config
from esc_agents.yaml_text import flow, parse


def distributions(config: TuneConfig) -> dict[str, BaseDistribution]:
    """The space, as Optuna has it. Raises UserError where it is none."""
    if not config.space:
        raise UserError(
            "space: expected at least one key, such as {ppo.gamma: {choices: [0.9, 0.95]}}, or a "
            "shipped search, --config ppo or --config sac"
        )
    found = {key: _distribution(key, said) for key, said in config.space.items()}
    for key, said in config.space.items():
        for value in said.get("choices", [said.get("low")]):
            try:
                train_config(config, {key: value}, 0)  # does a run have this key?
            except UserError as error:
                raise UserError(f"space: {str(error).removeprefix('train: ')}") from error
    return found


def _distribution(key: str, said: Any) -> BaseDistribution:
    try:
        keys = set(said)
        if keys == {"choices"}:
            return CategoricalDistribution([flow(choice) for choice in said["choices"]])
        if keys - {"log"} != {"low", "high"}:
            raise ValueError("other keys")
        low, high, log = said["low"], said["high"], said.get("log", False)
        if isinstance(low, int) and isinstance(high, int):
            return IntDistribution(low, high, log=log)
        return FloatDistribution(float(low), float(high), log=log)
    except (TypeError, ValueError, KeyError) as error:
        raise UserError(
            f"space: {key}: expected {{low: 1e-4, high: 1e-2, log: true}} or {{choices: [1, 2]}}, "
            f"got {said!r} ({error})"
        ) from error


def choose(config: TuneConfig, known: Sequence[FrozenTrial], count: int) -> list[Parameters]:
    """``count`` trials to make next, of what is known by now: the same for the same."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.TPESampler(
        seed=config.seed + len(known), n_startup_trials=config.round, constant_liar=True
    )
    study = optuna.create_study(direction="maximize", sampler=sampler)
    study.add_trials(known)
    chosen: list[Parameters] = [] if known else [{}]
    while len(chosen) < count:
        asked = study.ask(distributions(config)).params
        chosen.append({
            key: parse(value) if "choices" in config.space[key] else value
            for key, value in asked.items()
        })  # fmt: skip
    return chosen


def as_known(
    config: TuneConfig, parameters: Parameters, value: float | None, returns: Sequence[float]
) -> FrozenTrial:
    """What became of a trial, for Optuna. value: None where it was pruned, or could not be run."""
    own = scenario(config).model_dump()
    asked = {}
    for key, said in config.space.items():
        found = parameters[key] if key in parameters else _at(own, key)
        asked[key] = flow(found) if "choices" in said else found
    space = distributions(config)
    state = TrialState.COMPLETE if value is not None else TrialState.PRUNED
    if not all(_inside(space[key], value) for key, value in asked.items()):
        return create_trial(state=TrialState.FAIL)  # the scenario's own, outside of the space
    steps = dict(enumerate(returns))
    if value is None and not steps:
        return create_trial(state=TrialState.FAIL)
    return create_trial(
        state=state, value=value, params=asked, distributions=space, intermediate_values=steps
    )


def _inside(distribution: Any, value: Any) -> bool:
    if isinstance(distribution, CategoricalDistribution):
        return value in distribution.choices
    return value is not None and distribution.low <= value <= distribution.high


def _at(values: Any, key: str) -> Any:
    for part in key.split("."):
        values = values.get(part) if isinstance(values, dict) else None
    return list(values) if isinstance(values, tuple) else values
