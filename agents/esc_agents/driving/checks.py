"""What a user can get wrong in a run, found before anything is made."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import torch

from esc_agents.config import TrainConfig, check_env_id
from esc_agents.driving.environments import check_actions, in_training, make_env
from esc_agents.errors import UserError
from esc_agents.yaml_text import flow
from esc_gym.encoders import representation
from esc_gym.extractors import SetExtractor
from esc_gym.registration import merge


def check(config: TrainConfig) -> gym.Env:
    """One environment of the run, after everything that a user can get wrong was looked at."""
    try:
        representation(config.repr)
    except ValueError as error:
        raise UserError(f"repr: {error}") from error
    check_device(config.device)
    env = check_env(config)
    if config.hyperparameters.train_env_config:
        _check_training(config, env)
    given = config.encoder.arguments
    with _explained(f"{config.env}: encoder{f' {flow(given)}' if given else ''}"):
        _try_encoder(config, env)
    if config.hyperparameters.use_sde and isinstance(env.action_space, gym.spaces.Discrete):
        raise UserError(
            f"{config.algo}.use_sde: expected continuous actions, got {env.action_space}; leave it "
            "false"
        )
    if config.algo == "sac" and config.sac.hindsight:
        _check_hindsight(config, env)
    rollout = config.ppo.n_steps * config.n_envs
    if config.algo == "ppo" and config.ppo.batch_size > rollout:
        raise UserError(
            f"ppo.batch_size: expected at most n_steps * n_envs = {rollout}, got "
            f"{config.ppo.batch_size}; raise --ppo.n-steps or lower --ppo.batch-size"
        )
    return env


def check_seeds(config: TrainConfig) -> None:
    """Raises UserError where training would begin with episodes of the evaluations."""
    first, last = config.evaluation.seed, config.evaluation.seed + config.evaluation.episodes - 1
    if first - config.n_envs < config.seed <= last:
        raise UserError(
            f"seed: expected episodes that no evaluation has, which have the seeds {first} to "
            f"{last}; got {config.seed} for the first of {config.n_envs} environments"
        )


def _check_training(config: TrainConfig, env: Any) -> None:
    there: Any = check_env(in_training(config))
    if there.action_space != env.action_space:
        raise UserError(
            f"train_env_config: expected the actions that evaluations have, {env.action_space}, "
            f"got {there.action_space}"
        )
    here, wanted = (each.observation_space for each in (there, env))
    if here != wanted:
        shape, wanted_shape = (space["vehicles"].shape for space in (here, wanted))
        raise UserError(
            "train_env_config: expected observations of the same shape and range as in "
            f"evaluations, vehicles {wanted_shape}, got {shape}; other numbers of vehicles need "
            "observation.max_vehicles"
        )


def _check_hindsight(config: TrainConfig, env: gym.Env) -> None:
    if not config.observation.goal:
        raise UserError(
            "sac.hindsight: expected observation.goal true, got false; add --observation.goal, "
            "which only parking has"
        )
    base: Any = env.unwrapped
    there = merge(base.config, config.sac.train_env_config)
    longest = int(there["duration"] * there["policy_frequency"]) * config.n_envs
    if config.sac.learning_starts < longest:
        raise UserError(
            f"sac.learning_starts: expected at least {longest}, {config.n_envs} whole episodes, to "
            f"take goals of, got {config.sac.learning_starts}"
        )


def check_env(config: TrainConfig) -> gym.Env:
    """One environment of the run, which was made and made a step."""
    check_env_id(config.env)
    with _explained(config.env):
        check_actions(config)
        env = make_env(config)
        env.reset(seed=config.seed)
        env.step(env.action_space.sample())  # reward terms are read here for the first time
        return env


@contextmanager
def _explained(what: str) -> Iterator[None]:
    """A wrong value can make highway-env, or an encoder, raise anything: a UserError of it."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        reason = str(error).partition(" was raised from the environment creator")[0]
        raise UserError(f"{what}: {kind}{reason}") from error


def check_device(name: str) -> None:
    """Raises UserError unless torch can compute on the device called ``name``."""
    if name == "auto":
        return
    try:
        torch.empty(1, device=name).cpu()  # of "meta", too, torch makes tensors
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"device: expected auto, cpu or cuda, got {name!r}: {reason}") from error


def _try_encoder(config: TrainConfig, env: Any) -> None:
    extractor = SetExtractor(env.observation_space, **extractor_arguments(config))
    observation = env.observation_space.sample()
    extractor({name: torch.as_tensor(value[None]).float() for name, value in observation.items()})


def extractor_arguments(config: TrainConfig) -> dict[str, Any]:
    """What the run's ``SetExtractor`` is made with."""
    encoder = config.encoder
    return {
        "representation": config.repr,
        "hidden": list(encoder.hidden),
        "code_dim": encoder.code_dim,
        "match_parameters": encoder.match_parameters,
        **encoder.arguments,
    }
