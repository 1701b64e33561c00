"""One training run, from a configuration to a directory with a model and its results."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from torch.utils.tensorboard import SummaryWriter

from esc_agents import checkpoint, run
from esc_agents.callbacks import (
    Checkpoints,
    DrivingLog,
    Faults,
    FixedSeedEvaluation,
    MetricsWriter,
    StopOnSignal,
    Stopped,
)
from esc_agents.checks import check, check_device, extractor_arguments
from esc_agents.config import TrainConfig
from esc_agents.envs import factories, make_env
from esc_agents.errors import UserError
from esc_agents.evaluate import Summary, as_rows, blind_policies, evaluate, model_policy
from esc_agents.policies import load_policy, save_policy
from esc_agents.report import results_table, show
from esc_gym.extractors import SetExtractor
from esc_gym.fastsim import report
from esc_gym.matching import parameter_count

WORKERS_IMPORT = ["stable_baselines3.common.vec_env.subproc_vec_env", "esc_agents.envs"]
ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"ppo": PPO, "sac": SAC}


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
        "features_extractor_kwargs": extractor_arguments(config),
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


def train(
    config: TrainConfig, *, resume: Path | None = None, trust: bool = False,
    listeners: Sequence[BaseCallback] = (),
) -> bool:  # fmt: skip
    """Train as ``config`` says; prints the results. False where a signal ended it early.

    resume: an existing run directory, which goes on from its last checkpoint as if it had never
    stopped. trust: also from a checkpoint that somebody else wrote, which can run their code.
    listeners: further callbacks, which must not change the training.
    """
    directory = resume or config.run_dir or run.default_run_dir(config)
    with _said(directory), ExitStack() as stack:
        if resume:
            _check_unfinished(config, resume)
            stack.enter_context(run.locked(resume))
        else:
            run.check_free(directory)
        probe = check(config)
        envs, judges = (stack.enter_context(closing(made)) for made in _vectorised(config))
        model, found = _model(config, envs, resume, trust)
        if resume:
            run.note_session(resume, config)
        else:
            run.create(directory, config, wrapper_json(probe), str(model.device))
            stack.enter_context(run.locked(directory))
        training = Training(config, directory, model, probe, judges, listeners)
        say(describe(config, model, probe, directory))
        return training.run(found)


@contextmanager
def _said(directory: Path) -> Iterator[None]:
    """What disks and processes do to a run, as UserErrors."""
    try:
        yield
    except (EOFError, ConnectionError) as error:
        raise UserError(
            "the process of an environment died: killed, or out of memory; continue with "
            f"esc-train --resume {directory}"
        ) from error
    except OSError as error:  # full, or not ours to write
        raise UserError(
            f"{error.filename or directory}: {error.strerror}; what was written before is whole; "
            f"once that is mended, continue with esc-train --resume {directory}"
        ) from error


def _vectorised(config: TrainConfig) -> Iterator[VecEnv]:
    """Environments to train in, and to evaluate in."""
    yield vectorise(config, config.n_envs)
    yield vectorise(config, min(config.n_envs, config.evaluation.episodes), evaluation=True)


def _check_unfinished(config: TrainConfig, directory: Path) -> None:
    found = checkpoint.in_order(directory / "checkpoints")
    steps = int(found[-1].stem) if found else 0
    if steps >= config.steps and (directory / "results.json").exists():
        raise UserError(
            f"{directory} has {steps:,} of {config.steps:,} steps already; ask for more with "
            "--steps"
        )


def load_model(config: TrainConfig, directory: Path, trust: bool = False) -> tuple[Any, int]:
    """(policy, training steps) of a run: what it ended with, else its best evaluated.

    From the files that hold no code; where there are none, with ``trust`` from SB3's model.zip.
    """
    check_device(config.device)
    torch.set_num_threads(config.threads)
    device = str(get_device(config.device))
    for name in ("policy", "best_policy"):
        if (directory / f"{name}.json").exists():
            return load_policy(directory, device, name)
    path = directory / "model.zip"
    if not path.exists():
        raise UserError(f"{directory} holds no policy yet: expected policy.safetensors in it")
    if not trust:
        raise UserError(
            f"{path} holds pickled Python objects, and to load it can run code of whoever wrote "
            "it; add --trust if you trust them"
        )
    try:
        model = ALGORITHMS[config.algo].load(path, device=config.device)
    except Exception as error:
        raise UserError(f"{path} is damaged or of another version: {error}") from error
    say(f"Loaded {path}, which holds pickled Python objects")
    return model, model.num_timesteps


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


@contextmanager
def closing(envs: VecEnv) -> Iterator[VecEnv]:
    """Closes environments at the end, also where one of their processes is dead."""
    try:
        yield envs
    finally:
        try:
            envs.close()
        except (EOFError, OSError):
            for process in getattr(envs, "processes", ()):
                process.terminate()


class Training:
    """A run from where ``model`` stands to its results."""

    def __init__(
        self, config: TrainConfig, directory: Path, model: BaseAlgorithm, probe: gym.Env,
        judges: VecEnv, listeners: Sequence[BaseCallback],
    ) -> None:  # fmt: skip
        self.listeners = listeners
        self.config, self.directory, self.model = config, directory, model
        self.probe, self.judges = probe, judges
        self.save_policy = partial(
            save_policy, directory, model, config, extractor_arguments(config), wrapper_json(probe)
        )

    def run(self, found: dict[str, Any] | None) -> bool:
        """Train, evaluate, write and print. found: of ``checkpoint.restore``, None at the start."""
        config, directory, model = self.config, self.directory, self.model
        with StopOnSignal() as stop:
            self._learn(found, stop)
            run.write_atomically(directory / "model.zip", model.save)
            self.save_policy("policy")
            results = self._results(stop)
        run.write_checksums(directory)
        if stop.interrupted:
            say(f"Stopped after {model.num_timesteps:,} steps; the model is saved.")
            say(f"Continue with: esc-train --resume {directory}")
            return False
        run.write_json(directory / "results.json", as_rows(results))
        run.write_checksums(directory)
        title = f"{config.env}, {config.repr}, {config.algo}, {model.num_timesteps:,} steps"
        show(results_table(f"{title}; episodes: {config.evaluation.episodes}", results))
        say(f"Run directory: {directory}")
        return True

    def _learn(self, found: dict[str, Any] | None, stop: StopOnSignal) -> None:
        config, model, directory = self.config, self.model, self.directory
        begun = model.num_timesteps
        tensorboard = TensorBoardOutputFormat(str(directory / "tensorboard"))
        # Of what was logged between the checkpoint and the stop, TensorBoard shows nothing.
        tensorboard.writer = SummaryWriter(str(directory / "tensorboard"), purge_step=begun + 1)
        metrics = MetricsWriter(directory / "metrics.csv", begun)
        model.set_logger(Logger(str(directory), [metrics, tensorboard]))
        every = config.evaluation.every or max(1000, config.steps // 5)
        evaluation = FixedSeedEvaluation(self.judges, seeds(config), every, directory)
        evaluation.stopped = lambda: stop.interrupted
        evaluation.save_best = partial(self.save_policy, "best_policy")
        folder = directory / "checkpoints"
        saved = Checkpoints(folder, config.checkpoint_every, lambda: stop.interrupted, say)
        faults = Faults(config)
        saved.callbacks = callbacks = [faults, DrivingLog(), evaluation, saved]
        if found:
            checkpoint.resume(model, found, callbacks)
        try:
            if begun < config.steps:
                model.learn(
                    config.steps - begun, callback=[*callbacks, *self.listeners],
                    reset_num_timesteps=False, progress_bar=sys.stderr.isatty(),
                )  # fmt: skip
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

    def _results(self, stop: StopOnSignal) -> dict[str, Summary]:
        """The trained policy and the blind ones on the same episodes."""
        config, judges = self.config, self.judges
        names = action_names(self.probe)
        space, seed = self.probe.action_space, config.evaluation.seed
        blind = blind_policies(space, judges.num_envs, names, seed)
        policies = {config.repr: model_policy(self.model), **blind}
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


def seeds(config: TrainConfig) -> range:
    """Seeds of the evaluation's episodes."""
    return range(config.evaluation.seed, config.evaluation.seed + config.evaluation.episodes)


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
