"""The ids ``esc_gym/<highway-env id>``: highway-env with the set observation."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from copy import deepcopy
from difflib import get_close_matches
from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers highway-env's own ids)
import numpy as np
from gymnasium.envs.registration import load_env_creator
from highway_env import utils
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import (
    ContinuousAction,
    DiscreteAction,
    DiscreteMetaAction,
    MultiAgentAction,
)

from esc_gym.fastsim.behavior import original_behavior
from esc_gym.observation import SetObservation
from esc_gym.parking import SET_PARKING

NAMESPACE = "esc_gym"
MOST = 10_000  # vehicles, lanes, steps a second
HIGHWAY_ENV_IDS = tuple(
    spec.id for spec in gym.registry.values()
    if isinstance(spec.entry_point, str) and spec.entry_point.startswith("highway_env.envs.")
)  # fmt: skip
MULTI_AGENT_IDS = tuple(id for id in HIGHWAY_ENV_IDS if "multi-agent" in id)
ENV_IDS = tuple(f"{NAMESPACE}/{id}" for id in HIGHWAY_ENV_IDS if id not in MULTI_AGENT_IDS)


def register_envs() -> None:
    """Register ``esc_gym/<id>`` for all highway-env ids; the multi-agent ones refuse."""
    for base_id in HIGHWAY_ENV_IDS:
        if f"{NAMESPACE}/{base_id}" not in gym.registry:
            gym.register(
                f"{NAMESPACE}/{base_id}",
                entry_point="esc_gym.registration:make",
                vector_entry_point="esc_gym.vector.environment:make_vec",
                max_episode_steps=gym.registry[base_id].max_episode_steps,
                kwargs={"base_id": base_id},
            )


def make(
    base_id: str,
    config: Mapping[str, Any] | None = None,
    render_mode: str | None = None,
    **set_observation: Any,
) -> SetObservation:
    """Entry point of the ids: a highway-env environment with ``SetObservation`` on it.

    Args:
        base_id: the highway-env id.
        config: merged into that id's default configuration, nested dicts too; an ``action`` of
            another ``type`` replaces the default one whole. Unknown keys are refused.
        render_mode: ``"human"``, ``"rgb_array"`` or None.
        set_observation: arguments of ``SetObservation``.
    """
    if base_id in MULTI_AGENT_IDS:
        raise gym.error.UnregisteredEnv(
            f"{NAMESPACE}/{base_id} is multi-agent; esc_gym supports the {len(ENV_IDS)} "
            f"single-agent environments of highway-env, for example {NAMESPACE}/intersection-v0."
        )
    check_arguments(set_observation, make)
    env_class: Any = load_env_creator(str(gym.registry[base_id].entry_point))
    env_class = SET_PARKING.get(env_class, env_class)
    merged = merge_config(env_class.default_config(), config or {})
    # Constructing observes once before ours is there: cheap, and no crash on continuous u-turns.
    merged["observation"] = {"type": "Kinematics"}
    with original_behavior(_driver(merged["other_vehicles_type"])):
        return SetObservation(_construct(env_class, merged, render_mode), **set_observation)


def check_arguments(given: Iterable[str], maker: Callable[..., Any]) -> None:
    """Raises TypeError for an argument that is neither of ``maker`` nor of ``SetObservation``."""
    known = [
        name for function in (maker, SetObservation)
        for name, argument in inspect.signature(function).parameters.items()
        if argument.kind is not argument.VAR_KEYWORD and name not in ("base_id", "env")
    ]  # fmt: skip
    for name in given:
        if name not in known:
            raise TypeError(f"unexpected argument {name!r}; {_hint(name, known)}")


def _hint(name: str, known: Iterable[str]) -> str:
    known = list(known)
    near = get_close_matches(name, known, 1)
    guess = f"did you mean {near[0]!r}? " if near else ""
    return f"{guess}known: {', '.join(known)}."


def _driver(path: Any) -> Any:
    try:
        return utils.class_from_path(path)
    except (AttributeError, ImportError, ValueError) as error:
        raise ValueError(
            "config['other_vehicles_type']: expected a class to import, such as "
            f"'highway_env.vehicle.behavior.IDMVehicle', got {path!r}: {error}"
        ) from error


def _construct(
    env_class: type[AbstractEnv], config: dict[str, Any], render_mode: str | None
) -> AbstractEnv:
    """``env_class(config, render_mode)``, also for the classes that do not take both."""
    wanted = {"config": config, "render_mode": render_mode}
    accepted = inspect.signature(env_class).parameters
    env = env_class(**{name: value for name, value in wanted.items() if name in accepted})
    if not accepted.keys() >= wanted.keys():
        env.render_mode = render_mode
        env.configure(_changes(config, env_class.default_config()))
        env.config["offscreen_rendering"] = render_mode != "human"
    return env


def _changes(config: dict[str, Any], default: dict[str, Any]) -> dict[str, Any]:
    # parking-ActionRepeat-v0 and parking-parked-v0 set values in __init__, past default_config.
    return {key: value for key, value in config.items() if value != default[key]}


def merge_config(default: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """highway-env's ``default`` configuration with ``changes`` merged in (see ``merge``).

    Raises ValueError for a key that highway-env does not know, or a value that it cannot mean.
    """
    if not isinstance(changes, Mapping):
        raise ValueError(f"config: expected a mapping, got {changes!r}.")
    for key in changes:
        if key == "observation":
            raise ValueError(
                "config['observation'] has no effect here: esc_gym observes the set. Pass "
                "SetObservation's arguments instead (max_vehicles=, features=, order=, ...)."
            )
        # Reward terms are read by name, and not all of them stand in the defaults.
        term = key.endswith("_reward") and not get_close_matches(key, default, cutoff=0.9)
        if key not in default and not term:
            raise ValueError(f"config: unknown key {key!r}; {_hint(key, default)}")
        if isinstance(default.get(key), dict) and not isinstance(changes[key], Mapping):
            raise ValueError(f"config[{key!r}]: expected a mapping, got {changes[key]!r}.")
        _check(key, default.get(key), changes[key])
    merged = merge(default, changes)
    action, usual = merged["action"], default["action"]
    # Some ids' own configurations have keys that their kind of action does not know.
    own = usual if action["type"] == usual["type"] else {}
    _check_action(action, {*changes.get("action", {})} - {*own})
    lane, lanes = merged.get("initial_lane_id"), merged.get("lanes_count")
    whole = isinstance(lane, int | np.integer)
    if lane is not None and lanes is not None and not (whole and lane < lanes):
        raise ValueError(
            f"config['initial_lane_id']: expected a whole number below {lanes}, got {lane!r}."
        )
    return merged


def _check_action(config: Mapping[str, Any], given: Iterable[str]) -> None:
    """highway-env's classes of actions swallow whatever they do not know."""
    actions: dict[str, Any] = {
        kind.__name__: kind
        for kind in (ContinuousAction, DiscreteAction, DiscreteMetaAction, MultiAgentAction)
    }
    if config["type"] not in actions:
        raise ValueError(
            f"config['action']['type']: expected one of {', '.join(actions)}; got "
            f"{config['type']!r}."
        )
    known = {"type": None} | {
        name: None for kind in inspect.getmro(actions[config["type"]]) if "__init__" in vars(kind)
        for name in inspect.signature(kind).parameters if name not in ("env", "kwargs")
    }  # fmt: skip
    for key in given:
        if key not in known:
            raise ValueError(f"config['action']: unknown key {key!r}; {_hint(key, known)}")


def _check(key: str, default: Any, value: Any) -> None:
    """highway-env itself would fail later, drive on an empty road, or build one for hours."""
    boolean = isinstance(value, bool | np.bool_)
    number = not boolean and isinstance(value, int | float | np.number) and value == value  # no NaN
    whole = number and isinstance(value, int | np.integer)
    if isinstance(default, bool):
        good, expected = boolean, "true or false"
    elif isinstance(default, list) and key.endswith("_range"):
        expected = "two rising numbers"
        good = np.shape(value) == (2,) and bool(np.greater(*np.flip(value)))
    elif not isinstance(default, int | float) and not key.endswith("_reward"):
        return
    elif key == "lanes_count":
        good, expected = whole and 1 <= value <= MOST, f"a whole number from 1 to {MOST}"
    elif key.endswith("_count"):
        good, expected = whole and 0 <= value <= MOST, f"a whole number from 0 to {MOST}"
    elif key.endswith("_density"):
        good, expected = number and 1 / MOST <= value <= MOST, f"a number from {1 / MOST} to {MOST}"
    elif key.endswith("_frequency"):
        good, expected = number and 0 < value <= MOST, f"a number above 0, at most {MOST}"
    elif key == "duration":
        good, expected = number and value >= 0, "a number of at least 0"
    else:
        good, expected = number, "a number"
    if not good:
        raise ValueError(f"config[{key!r}]: expected {expected}, got {value!r}.")


def merge(config: Mapping[str, Any], *changes: Mapping[str, Any]) -> dict[str, Any]:
    """highway-env configurations merged, later ones winning, nested mappings too.

    A nested mapping whose ``type`` changes is replaced: the arguments of one action type mean
    nothing to another.
    """
    merged = deepcopy(dict(config))
    for change in changes:
        for key, value in deepcopy(dict(change)).items():
            old = merged.get(key)
            if isinstance(old, Mapping) and isinstance(value, Mapping):
                same = value.get("type", old.get("type")) == old.get("type")
                value = {**old, **value} if same else value
            merged[key] = value
    return merged
