"""Several environments of a run stepped as one."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from esc_agents.config import TrainConfig
from esc_agents.driving.environments import factories, make_env
from esc_gym.fastsim import report

WORKERS_IMPORT = [
    "stable_baselines3.common.vec_env.subproc_vec_env",
    "esc_agents.driving.environments",
]


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
