"""One training run, from a configuration to a directory with a model and its results."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.vec_env import VecEnv
from torch.utils.tensorboard import SummaryWriter

from esc_agents import files
from esc_agents.config import TrainConfig
from esc_agents.driving.baselines import action_names
from esc_agents.driving.checks import check, check_seeds
from esc_agents.driving.environments import in_training, wrapper_json
from esc_agents.driving.episodes import Summary, model_policy, seeds
from esc_agents.driving.policies import save_policy, start_from
from esc_agents.driving.vectorised import closing, vectorise
from esc_agents.errors import UserError, say
from esc_agents.training import checkpoint, run_directory
from esc_agents.training.callbacks import (
    Checkpoints,
    DrivingLog,
    EntropySchedule,
    Faults,
    FixedSeedEvaluation,
    LastingNoise,
    MetricsWriter,
    StopOnSignal,
    Stopped,
    ValueWarmup,
)
from esc_agents.training.models import ALGORITHMS, describe, new_model
from esc_agents.training.results import finish, results, rule_summary


def train(
    config: TrainConfig, *, resume: Path | None = None, trust: bool = False,
    listeners: Sequence[BaseCallback] = (),
) -> bool:  # fmt: skip
    """Train as ``config`` says; prints the results. False where a signal ended it early.

    resume: an existing run directory, which goes on from its last checkpoint as if it had never
    stopped. trust: also from a checkpoint that somebody else wrote, which can run their code.
    listeners: further callbacks, which must not change the training.
    """
    directory = resume or config.run_dir or run_directory.default_run_dir(config)
    with run_directory.said(directory, "esc-train"), ExitStack() as stack:
        if resume:
            _check_unfinished(config, resume, trust)
            stack.enter_context(run_directory.locked(resume))
        else:
            check_seeds(config)
            run_directory.check_free(directory)
        probe = check(config)
        envs, judges = (stack.enter_context(closing(made)) for made in _vectorised(config))
        model, found = _model(config, envs, resume, trust)
        if config.start_from and found is None:
            start_from(model.policy, config.start_from, config.algo, wrapper_json(probe), trust)
        if resume:
            run_directory.note_session(resume, config)
        else:
            run_directory.create(directory, config, wrapper_json(probe), str(model.device))
            stack.enter_context(run_directory.locked(directory))
        training = Training(config, directory, model, probe, judges, listeners)
        say(describe(config, model, probe))
        say(f"{config.steps:,} steps into {directory}")
        _warn_of_one_rollout(config)
        return training.run(found)


def _warn_of_one_rollout(config: TrainConfig) -> None:
    """SB3 sets the rate after the rollout, by what is left of the steps then."""
    rollout = config.ppo.n_steps * config.n_envs
    linear = config.ppo.learning_rate_schedule == "linear"
    if config.algo == "ppo" and linear and config.steps <= rollout:
        say(
            f"Nothing will be learned: these are no more steps than one rollout has, {rollout:,}, "
            "and after the last rollout a linear learning rate is 0; give more --steps"
        )


def _vectorised(config: TrainConfig) -> Iterator[VecEnv]:
    """Environments to train in, and to evaluate in."""
    yield vectorise(in_training(config), config.n_envs)
    yield vectorise(config, min(config.n_envs, config.evaluation.episodes), evaluation=True)


def _check_unfinished(config: TrainConfig, directory: Path, trust: bool) -> None:
    if (directory / run_directory.IMITATE).exists():
        raise UserError(
            f"{directory} is a run of esc-imitate: continue it with esc-imitate --resume, or begin "
            f"a run with its weights, with --start-from {directory}"
        )
    finished = run_directory.finished(directory)
    found = checkpoint.in_order(directory / "checkpoints")
    if finished and not found:
        raise UserError(
            f"{directory} is finished, and without checkpoints it cannot go on; for more steps "
            f"start anew, in another directory: esc-train --config {directory / 'config.yaml'}"
        )
    other = config.steps != run_directory.open_run(directory, trust).steps
    steps = int(found[-1].stem) if found else 0
    if (finished or other) and steps >= config.steps:
        raise UserError(
            f"{directory} has {steps:,} of {config.steps:,} steps already; ask for more with "
            "--steps"
        )


def _model(
    config: TrainConfig, envs: VecEnv, resume: Path | None, trust: bool
) -> tuple[BaseAlgorithm, dict[str, Any] | None]:
    """(a new model, None), or what ``checkpoint.restore`` makes of a run's newest checkpoint."""
    state = newest_state(resume, trust) if resume else None
    if state is None:
        return new_model(config, envs), None
    torch.set_num_threads(config.threads)
    try:
        return checkpoint.restore(state, ALGORITHMS[config.algo], envs)
    except UserError:
        raise
    except Exception as error:  # what unpickling old classes can raise is anybody's guess
        raise UserError(
            f"the checkpoint of {resume} does not load with the versions installed here (those of "
            f"the run are in versions.json): {type(error).__name__}: {error}"
        ) from error


def newest_state(directory: Path, trust: bool) -> bytes | None:
    """The newest whole checkpoint of a run; damaged ones are named. None before the first one."""
    paths = checkpoint.in_order(directory / "checkpoints")
    if not paths:
        say(f"{directory} holds no checkpoint yet: it starts from the beginning")
        return None
    for path in reversed(paths):
        try:
            state = checkpoint.read(path, trust)
        except checkpoint.Damaged as damaged:
            say(f"{damaged}; the one before it is taken")
            continue
        say(f"Continuing from {path}")
        return state
    raise UserError(
        f"{directory} holds no whole checkpoint; start it anew, in another directory, with the "
        f"command in {directory / 'command.txt'}"
    )


class Training:
    """A run from where ``model`` stands to its results."""

    def __init__(
        self, config: TrainConfig, directory: Path, model: BaseAlgorithm, probe: gym.Env,
        judges: VecEnv, listeners: Sequence[BaseCallback],
    ) -> None:  # fmt: skip
        self.listeners = listeners
        self.config, self.directory, self.model = config, directory, model
        self.probe, self.judges = probe, judges
        self.save_policy = partial(save_policy, directory, model, config, wrapper_json(probe))

    def run(self, found: dict[str, Any] | None) -> bool:
        """Train, evaluate, write and print. found: of ``checkpoint.restore``, None at the start."""
        config, directory, model = self.config, self.directory, self.model
        with StopOnSignal() as stop:
            rule = rule_summary(config, stop)
            self._learn(found, stop, rule)
            files.write_atomically(directory / "model.zip", model.save)
            self.save_policy("policy")
            names = action_names(self.probe)
            found_out = results(config, model_policy(model), self.judges, names, rule, stop)
        if stop.interrupted:
            at, kept = model.num_timesteps, checkpoint.in_order(directory / "checkpoints")
            begins = int(kept[-1].stem) if kept else 0
            back = f" From step {begins:,} on it is done again." if begins < at else ""
            say(f"Stopped after {at:,} steps; the model is saved.{back}")
            say(f"Continue with: esc-train --resume {directory}")
            return False
        finish(config, directory, found_out, model.num_timesteps)
        return True

    def _learn(
        self, found: dict[str, Any] | None, stop: StopOnSignal, rule: Summary | None
    ) -> None:
        config, model, directory = self.config, self.model, self.directory
        begun = model.num_timesteps
        tensorboard = TensorBoardOutputFormat(str(directory / "tensorboard"))
        # Of what was logged between the checkpoint and the stop, TensorBoard shows nothing.
        tensorboard.writer = SummaryWriter(str(directory / "tensorboard"), purge_step=begun + 1)
        metrics = MetricsWriter(directory / "metrics.csv", begun)
        model.set_logger(Logger(str(directory), [metrics, tensorboard]))
        every = config.evaluation.every or max(1000, config.steps // 5)
        evaluation = FixedSeedEvaluation(self.judges, seeds(config), every, directory)
        evaluation.stopped = stop
        evaluation.rule = rule
        evaluation.save_best = partial(self.save_policy, "best_policy")
        folder = directory / "checkpoints"
        saved = Checkpoints(folder, config.checkpoint_every, stop, say)
        faults = Faults(config)
        saved.callbacks = callbacks = [faults, DrivingLog(), evaluation, saved]
        if config.algo == "ppo" and config.ppo.ent_coef_schedule == "linear":
            callbacks.append(EntropySchedule(config))
        if config.algo == "ppo" and config.ppo.value_warmup:
            callbacks.append(ValueWarmup(config))
        if config.hyperparameters.use_sde:
            callbacks.append(LastingNoise(config))
        if found:
            checkpoint.resume(model, found, callbacks)
        try:
            if begun < config.steps:
                model.learn(
                    config.steps - begun, callback=[*callbacks, *self.listeners],
                    reset_num_timesteps=False, progress_bar=sys.stderr.isatty(),
                )  # fmt: skip
                faults.check_weights()  # after the last update no rollout starts
                model.logger.dump(model.num_timesteps)
                saved.model = model
                saved.save()
        except Stopped:
            pass
        except ValueError:
            faults.check_weights()  # if they are the reason, of which torch says only what it saw
            raise
        finally:
            saved.writer.wait()
            model.logger.close()
        checkpoint.thin_out(folder)  # for a session that was killed before it had done so
