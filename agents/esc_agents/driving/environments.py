"""One environment of a run, or many factories of it, as its configuration says.

Worker processes import this module, which itself needs no torch.
"""

from __future__ import annotations

import json
import os
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any, get_args

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

from esc_agents.config import Algorithm, AlgorithmConfig, TrainConfig
from esc_agents.driving.rule_driver import RuleDriver
from esc_agents.driving.wrappers import DrivingMonitor, Progress, SeededEpisodes, Worker
from esc_agents.errors import UserError
from esc_agents.yaml_text import flow
from esc_gym.registration import NAMESPACE, merge, merge_config
from esc_gym.scenarios import scenario_of_class


def env_config(config: TrainConfig) -> dict[str, Any]:
    """The highway-env configuration of a run: the scenario's, changed by ``continuous`` for SAC."""
    preset = config.continuous.env_config if config.algo == "sac" and config.continuous else {}
    return merge(config.env_config, preset)


def in_training(config: TrainConfig) -> TrainConfig:
    """The run as its training environments are, with ``train_env_config``."""
    merged = merge(env_config(config), config.hyperparameters.train_env_config)
    task = config.continuous and config.continuous.model_copy(update={"env_config": {}})
    return config.model_copy(update={"env_config": merged, "continuous": task})


def with_env_config(config: TrainConfig, given: dict[str, Any]) -> TrainConfig:
    """A run in a changed scenario; changed also in what the recipe changes for SAC and training."""

    def merged(own: dict[str, Any]) -> dict[str, Any]:
        return merge(own, {key: given[key] for key in own.keys() & given.keys()})

    update: dict[str, Any] = {"env_config": merge(config.env_config, given)}
    if task := config.continuous:
        more = {"env_config": merged(task.env_config)}
        update["continuous"] = task.model_copy(update=more)
    for algo in get_args(Algorithm):
        own: AlgorithmConfig = getattr(config, algo)
        more = {"train_env_config": merged(own.train_env_config)}
        update[algo] = own.model_copy(update=more)
    return config.model_copy(update=update)


def actions(config: TrainConfig) -> dict[str, Any]:
    """The ``action`` section of a run's whole highway-env configuration."""
    return merge_config(_env_class(config).default_config(), env_config(config))["action"]


def _env_class(config: TrainConfig) -> Any:
    return load_env_creator(str(gym.registry[config.env].entry_point))


def check_actions(config: TrainConfig) -> None:
    """Raises UserError where algorithm and action space cannot meet, with the reason."""
    action = actions(config)["type"]
    scenario = scenario_of_class(_env_class(config))
    reason = scenario.discrete_only if scenario else None
    wanted = "continuous actions" if config.algo == "ppo" else "--algo sac"
    if reason and (action == "ContinuousAction" or config.algo == "sac"):
        raise UserError(
            f"{wanted} on {config.env}: highway-env cannot do continuous actions here, since "
            f"{reason}; use --algo ppo with meta-actions"
        )
    if config.algo == "sac" and action != "ContinuousAction":
        raise UserError(
            f"--algo sac on {config.env}: expected continuous actions, got {action}; give the "
            "scenario a `continuous` section, or --env-config '{action: {type: ContinuousAction}}'"
        )


def observation_arguments(config: TrainConfig, shuffle: bool = False) -> dict[str, Any]:
    """Arguments of the run's ``SetObservation``. shuffle: permute the rows of every observation."""
    observation = config.observation.model_dump()
    if shuffle:
        observation["order"] = "shuffled"
    elif observation["order"] is None:
        observation["order"] = "shuffled" if config.repr == "ap" else "road"
    return observation


@contextmanager
def named_version() -> Iterator[None]:
    """Who names a version means it: Gymnasium's advice to take a newer one is not shown."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*is out of date.*", DeprecationWarning)
        yield


def make_env(
    config: TrainConfig,
    *,
    shuffle: bool = False,
    render_mode: str | None = None,
    evaluation: bool = False,
    rule_driver: bool = False,
) -> gym.Env:
    """One environment of a run.

    shuffle: permute the rows of every observation. evaluation: also measure times to collision.
    rule_driver: IDM and MOBIL drive the ego.
    """
    with named_version():
        env = gym.make(
            f"{NAMESPACE}/{config.env}",
            config=env_config(config),
            render_mode=render_mode,
            disable_env_checker=True,
            **observation_arguments(config, shuffle),
        )
    if rule_driver:
        env = RuleDriver(env)
    task = config.continuous if config.algo == "sac" else None
    if task and (task.progress_reward or task.offroad_terminal):
        env = Progress(env, task.progress_reward, task.offroad_terminal)
    env = DrivingMonitor(env, ttc=evaluation)
    return SeededEpisodes(env) if evaluation else env


class EnvFactory:
    """Picklable ``make_env``, in a ``Worker``, for SB3's vectorised environments."""

    def __init__(self, config: TrainConfig, **options: Any) -> None:
        self.config, self.options, self.parent = config, options, os.getpid()

    def __call__(self) -> gym.Env:
        if os.getpid() != self.parent:
            # Ctrl-C reaches the whole process group; the parent decides when workers end.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        return Worker(make_env(self.config, **self.options))


def factories(config: TrainConfig, count: int, **options: Any) -> list[Callable[[], gym.Env]]:
    """``count`` factories of the run's environment."""
    return [EnvFactory(config, **options) for _ in range(count)]


MEANING = ("features", "ego_features", "frame", "perception_distance", "ranges", "limits")
"""What of ``wrapper_json`` weights depend on."""


def other_meaning(here: dict[str, Any], there: dict[str, Any], where: str = "there") -> str:
    """In what two ``wrapper_json``, one of them from a file, differ for weights; "" if in nothing.

    For messages: "KEY ITS VALUE there and ITS VALUE here", of long values only what differs.
    where: what "there" is called.
    """
    mine = json.loads(json.dumps(here))
    for key in MEANING:
        if mine[key] != there.get(key):
            pair = there.get(key), mine[key]
            apart = _without(*pair), _without(*reversed(pair))
            theirs, ours = apart if any(apart) else pair  # if in nothing, then in their order
            return f"{key} {flow(theirs)} {where} and {flow(ours)} here"
    return ""


def _without(value: Any, other: Any) -> Any:
    """What of a list or mapping the other has not; of anything else all."""
    if isinstance(value, list) and isinstance(other, list):
        return [entry for entry in value if entry not in other]
    if isinstance(value, dict) and isinstance(other, dict):
        return {key: entry for key, entry in value.items() if other.get(key) != entry}
    return value


def wrapper_json(env: gym.Env) -> dict[str, Any]:
    """The observation of a run, resolved: what the model's inputs mean."""
    spec = asdict(env.get_wrapper_attr("set_spec"))
    return {**spec, "d1": len(spec["features"]), "d2": len(spec["ego_features"])}
