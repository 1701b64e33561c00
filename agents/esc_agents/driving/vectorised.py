"""Several environments of a run stepped as one."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from esc_agents.config import TrainConfig
from esc_agents.driving.batch import BatchVecEnv, cores
from esc_agents.driving.environments import factories, make_env
from esc_agents.errors import UserError
from esc_agents.workers import out_of_reach
from esc_gym.fastsim import report
from esc_gym.vector.families import family_of
from esc_gym.vector.objects import reset_quietly

WORKERS_IMPORT = [
    "stable_baselines3.common.vec_env.subproc_vec_env",
    "esc_agents.driving.environments",
]


def vectorise(config: TrainConfig, count: int, **options: Any) -> VecEnv:
    """``count`` environments of the run: in the batch engine if it can, else as objects.

    options: of ``make_env``. Raises UserError where the engine is asked for what it cannot do.
    """
    if config.vec in ("auto", "batch") and not options.get("rule_driver"):
        if not (reason := unknown_to_engine(config)):
            return BatchVecEnv(config, count, **options)
        if config.vec == "batch":
            raise UserError(
                f"vec: batch: the batch engine does not simulate this {config.env}: {reason}; "
                "auto takes what is fastest here, with the same results"
            )
    if config.algo == "ppo" and config.ppo.crash_replay and not options.get("evaluation"):
        reason = unknown_to_engine(config) or f"vec is {config.vec}, where auto would take it"
        raise UserError(
            "ppo.crash_replay: expected 0 without the batch engine, got "
            f"{config.ppo.crash_replay:g}: {reason}; give --ppo.crash-replay 0 to train without"
        )
    made = factories(config, count, **options)
    if config.vec != "subproc" and not (config.vec == "auto" and _worth_processes(config, count)):
        return DummyVecEnv(made)
    if "forkserver" in multiprocessing.get_all_start_methods():
        # Workers are forked off a process that has imported all this, instead of each importing.
        multiprocessing.get_context("forkserver").set_forkserver_preload(WORKERS_IMPORT)
    with out_of_reach():
        return SubprocVecEnv(made)


def unknown_to_engine(config: TrainConfig) -> str:
    """Why the batch engine does not simulate a run's environments; "" if it does."""
    if not config.observation.accelerate:
        return "observation.accelerate is false"
    env: Any = make_env(config)
    reset_quietly(env)
    return family_of(env.unwrapped)[1]


def _worth_processes(config: TrainConfig, count: int) -> bool:
    """Whether ``count`` environments have more to compute than to say to each other."""
    if count < 2 or cores() < 2:
        return False
    env = make_env(config)
    try:
        env.reset(seed=config.seed)
        env.step(env.action_space.sample())
        return report(env).compiled == 0
    finally:
        env.close()


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
