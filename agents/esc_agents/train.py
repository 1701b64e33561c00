"""One training run, from a configuration to a directory with a model and its results."""

from __future__ import annotations

import multiprocessing
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from esc_agents import run
from esc_agents.callbacks import (
    Checkpoints,
    DrivingLog,
    FixedSeedEvaluation,
    MetricsWriter,
    StopOnInterrupt,
)
from esc_agents.config import TrainConfig, check_env_id
from esc_agents.envs import check_actions, factories, make_env
from esc_agents.errors import UserError
from esc_agents.evaluate import Summary, as_rows, blind_policies, evaluate, model_policy
from esc_agents.report import results_table, show
from esc_gym.encoders import representation
from esc_gym.extractors import SetExtractor
from esc_gym.fastsim import report
from esc_gym.matching import parameter_count

WORKERS_IMPORT = ["stable_baselines3.common.vec_env.subproc_vec_env", "esc_agents.envs"]
ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"ppo": PPO, "sac": SAC}


def check(config: TrainConfig) -> gym.Env:
    """One environment of the run, after everything that a user can get wrong was looked at."""
    try:
        representation(config.repr)
    except ValueError as error:
        raise UserError(f"repr: {error}") from error
    check_env_id(config.env)
    check_device(config.device)
    try:
        check_actions(config)
        env = make_env(config)
        env.reset(seed=config.seed)
        env.step(env.action_space.sample())  # reward terms are read here for the first time
        _try_encoder(config, env)
    except UserError:
        raise
    except Exception as error:  # a wrong value in env_config can make highway-env raise anything
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        reason = str(error).partition(" was raised from the environment creator")[0]
        raise UserError(f"{config.env}: {kind}{reason}") from error
    rollout = config.ppo.n_steps * config.n_envs
    if config.algo == "ppo" and config.ppo.batch_size > rollout:
        raise UserError(
            f"ppo.batch_size: expected at most n_steps * n_envs = {rollout}, got "
            f"{config.ppo.batch_size}; raise --ppo.n-steps or lower --ppo.batch-size"
        )
    return env


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
    extractor = SetExtractor(env.observation_space, **_arguments(config))
    observation = env.observation_space.sample()
    extractor({name: torch.as_tensor(value[None]).float() for name, value in observation.items()})


def _arguments(config: TrainConfig) -> dict[str, Any]:
    encoder = config.encoder
    return {
        "representation": config.repr,
        "hidden": list(encoder.hidden),
        "code_dim": encoder.code_dim,
        "match_parameters": encoder.match_parameters,
        **encoder.arguments,
    }


def vectorise(config: TrainConfig, count: int, **options: Any) -> VecEnv:
    """``count`` environments of the run, in processes of their own where that pays."""
    made = factories(config, count, **options)
    if config.vec == "dummy" or (config.vec == "auto" and not _worth_processes(config, count)):
        return DummyVecEnv(made)
    if "forkserver" in multiprocessing.get_all_start_methods():
        # Workers are forked off a process that has imported all this, instead of each importing.
        multiprocessing.get_context("forkserver").set_forkserver_preload(WORKERS_IMPORT)
    return SubprocVecEnv(made)


def _worth_processes(config: TrainConfig, count: int) -> bool:
    """Whether ``count`` environments have more to compute than to say to each other."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if count < 2 or (cores or 1) < 2:
        return False
    env = make_env(config)
    try:
        env.reset(seed=config.seed)
        env.step(env.action_space.sample())
        return report(env).compiled == 0
    finally:
        env.close()


def new_model(config: TrainConfig, envs: VecEnv) -> BaseAlgorithm:
    """An untrained SB3 model of the run's algorithm and representation."""
    torch.set_num_threads(config.threads)
    settings = config.hyperparameters.model_dump(exclude={"net_arch", "ortho_init"})
    policy: dict[str, Any] = {
        "features_extractor_class": SetExtractor,
        "features_extractor_kwargs": _arguments(config),
        "net_arch": list(config.hyperparameters.net_arch),
    }
    # One kernel instead of one per tensor and operation: the same Adam, a third less time.
    adam: dict[str, Any] = {"fused": True}
    if config.algo == "ppo":
        policy["ortho_init"] = config.ppo.ortho_init
        adam["eps"] = 1e-5  # what SB3 takes where it is given no arguments
    policy["optimizer_kwargs"] = adam
    try:
        return ALGORITHMS[config.algo](
            "MultiInputPolicy",  # type: ignore[arg-type]
            envs,
            policy_kwargs=policy,
            seed=config.seed,
            device=config.device,
            **settings,
        )
    except MemoryError as error:
        raise UserError(f"{config.algo}: buffer_size, n_steps or n_envs: {error}") from error


def train(config: TrainConfig, *, resume: Path | None = None) -> bool:
    """Train as ``config`` says; prints the results. False where Ctrl-C ended it early.

    resume: an existing run directory to continue; its weights and step count go on, environments
    and random generators start afresh.
    """
    directory = resume or config.run_dir or run.default_run_dir(config)
    if not resume:
        run.check_free(directory)
    probe = check(config)
    model = _load(config, directory) if resume else None
    envs = vectorise(config, config.n_envs)
    judges = vectorise(config, min(config.n_envs, config.evaluation.episodes), evaluation=True)
    try:
        if model:
            model.set_env(envs)
            run.note_session(directory, config)
        else:
            model = new_model(config, envs)
            run.create(directory, config, wrapper_json(probe), str(model.device))
        say(describe(config, model, probe, directory))
        with StopOnInterrupt() as stop:
            _learn(config, model, directory, judges, stop)
            run.write_atomically(directory / "model.zip", model.save)
            results = _results(config, model, judges, probe, stop)
        if stop.interrupted:
            done = model.num_timesteps >= config.steps
            command = "esc-eval" if done else "esc-train --resume"
            say(f"Interrupted after {model.num_timesteps:,} steps; the model is saved.")
            say(f"{'Evaluate it' if done else 'Continue'} with: {command} {directory}")
            return False
        run.write_json(directory / "results.json", as_rows(results))
        title = f"{config.env}, {config.repr}, {config.algo}, {model.num_timesteps:,} steps"
        show(results_table(f"{title}; episodes: {config.evaluation.episodes}", results))
        say(f"Run directory: {directory}")
        return True
    finally:
        envs.close()
        judges.close()


def load_model(config: TrainConfig, directory: Path) -> BaseAlgorithm:
    """The newest saved model of a run, without environments."""
    check_device(config.device)
    torch.set_num_threads(config.threads)
    path = run.latest_model(directory)
    try:
        return ALGORITHMS[config.algo].load(path, device=config.device)
    except Exception as error:
        raise UserError(f"{path} is damaged or of another version: {error}") from error


def _load(config: TrainConfig, directory: Path) -> BaseAlgorithm:
    model = load_model(config, directory)
    if model.num_timesteps >= config.steps:
        raise UserError(
            f"{directory} has {model.num_timesteps:,} of {config.steps:,} steps already; "
            "ask for more with --steps"
        )
    return model


def _learn(
    config: TrainConfig,
    model: BaseAlgorithm,
    directory: Path,
    judges: VecEnv,
    stop: StopOnInterrupt,
) -> None:
    writers = [
        MetricsWriter(directory / "metrics.csv", model.num_timesteps),
        TensorBoardOutputFormat(str(directory / "tensorboard")),
    ]
    model.set_logger(Logger(str(directory), writers))
    evaluation = FixedSeedEvaluation(
        judges, seeds(config), config.evaluation.every or max(1000, config.steps // 5), directory
    )
    evaluation.stopped = lambda: stop.interrupted
    checkpoints = Checkpoints(directory / "checkpoints", config.checkpoint_every)
    model.learn(
        config.steps - model.num_timesteps,
        callback=[stop, DrivingLog(), evaluation, checkpoints],
        reset_num_timesteps=False,
        progress_bar=sys.stderr.isatty(),
    )
    model.logger.dump(model.num_timesteps)
    model.logger.close()


def seeds(config: TrainConfig) -> range:
    """Seeds of the evaluation's episodes."""
    return range(config.evaluation.seed, config.evaluation.seed + config.evaluation.episodes)


def _results(
    config: TrainConfig, model: BaseAlgorithm, judges: VecEnv, probe: gym.Env, stop: StopOnInterrupt
) -> dict[str, Summary]:
    """The trained policy and the blind ones on the same episodes."""
    names = action_names(probe)
    blind = blind_policies(probe.action_space, judges.num_envs, names, config.evaluation.seed)
    policies = {config.repr: model_policy(model), **blind}
    results = {}
    if not stop.interrupted:
        say(f"Evaluating {config.repr} beside {len(blind)} blind policies ...")
    for name, policy in policies.items():
        if stop.interrupted:
            break
        episodes = evaluate(judges, policy, seeds(config), lambda: stop.interrupted)
        if episodes:
            results[name] = Summary.of(episodes)
    return results


def action_names(env: Any) -> dict[int, str]:
    """highway-env's names of the discrete actions."""
    return getattr(env.unwrapped.action_type, "actions", {})


def describe(config: TrainConfig, model: BaseAlgorithm, env: Any, directory: Path) -> str:
    """What is about to be trained, on two lines."""
    network: Any = model.policy if config.algo == "ppo" else model.policy.actor
    extractor = network.features_extractor
    n, d1 = env.observation_space["vehicles"].shape
    (d2,) = env.observation_space["ego"].shape
    return (
        f"{config.env}: sets of up to N={n} vehicles, d1={d1}, d2={d2}; {config.repr}: "
        f"{extractor.features_dim} features, {parameter_count(extractor):,} parameters; "
        f"{config.algo} on {model.device}, {config.n_envs} environments\n"
        f"{config.steps:,} steps into {directory}"
    )


def wrapper_json(env: gym.Env) -> dict[str, Any]:
    """The observation of a run, resolved: what the model's inputs mean."""
    spec = asdict(env.get_wrapper_attr("set_spec"))
    return {**spec, "d1": len(spec["features"]), "d2": len(spec["ego_features"])}


def say(text: str) -> None:
    """To people, at once."""
    print(text, flush=True)
