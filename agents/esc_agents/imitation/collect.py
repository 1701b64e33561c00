"""esc-collect's work: drive with an expert, and keep what it thought of every step."""

from __future__ import annotations

from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np

from esc_agents import files
from esc_agents.config import TrainConfig, dump
from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.checks import check_env
from esc_agents.driving.environments import wrapper_json
from esc_agents.driving.vectorised import closing
from esc_agents.errors import UserError, say
from esc_agents.imitation import datasets, labels
from esc_agents.imitation.experts import Expert, expert_of
from esc_agents.imitation.settings import CollectConfig
from esc_agents.training.callbacks import StopOnSignal
from esc_agents.training.run_directory import locked


def collect(config: CollectConfig, out: Path, trust: bool = False) -> bool:
    """Make the data set ``out``; False where a signal ended it early, after which it goes on.

    Episodes are kept in parts beside it until all are there. trust: as of ``load_model``.
    """
    datasets.check_name(out)
    datasets.minari()
    if out.exists():
        raise UserError(f"out: {out} already exists; give another --out, or remove it")
    run = config.train_config()
    expert = expert_of(config.expert, config.planner, run, trust)
    parts = out.with_name(f".{out.name}.parts")
    _begin(parts, config)
    with locked(parts), StopOnSignal() as stop:
        drives = _drive(config, run, expert, parts, stop)
    if stop.interrupted:
        say(f"Stopped after {len(drives):,} of {config.episodes:,} episodes, which are kept.")
        say("Give the same command again to go on.")
        return False
    env: Any = check_env(run).env  # type: ignore[attr-defined]  # as gym.make gives it
    count = len(drives[0].values[0])
    about = {
        "expert": config.expert, "actions": count, "observation": wrapper_json(env),
        "collect": config.model_dump(mode="json"), "run": dump(run), "versions": files.versions(),
    }  # fmt: skip
    datasets.write(out, drives, env, about)
    rmtree(parts)
    steps = sum(len(drive.actions) for drive in drives)
    mean = np.mean([drive.rewards.sum() for drive in drives])
    say(f"{len(drives):,} episodes, {steps:,} labels, mean return {mean:.2f}: {out}")
    return True


def _begin(parts: Path, config: CollectConfig) -> None:
    """The folder of parts; raises UserError where one is there of another command."""
    text = config.model_dump_json(indent=2) + "\n"
    noted = parts / "collect.json"
    if noted.is_file() and noted.read_text(encoding="utf-8") != text:
        raise UserError(
            f"{parts} holds episodes of a command with other values; remove it, or give another "
            "--out"
        )
    try:
        parts.mkdir(parents=True, exist_ok=True)
        files.write_text(noted, text)
    except OSError as error:
        raise UserError(f"out: {parts}: {error.strerror}") from error


def _drive(
    config: CollectConfig, run: TrainConfig, expert: Expert, parts: Path, stop: StopOnSignal
) -> list[labels.Drive]:
    """All episodes, those of earlier sessions too."""
    found: list[labels.Drive] = []
    last = config.seed + config.episodes
    with closing(BatchVecEnv(run, config.n_envs, evaluation=True)) as envs:
        for first in range(config.seed, last, config.n_envs):
            path = parts / f"{first:010d}.npz"
            if not path.exists():
                seeds = range(first, min(first + config.n_envs, last))
                generator = np.random.default_rng([config.seed, first])
                drives = labels.collect(envs, seeds, expert, None, config.noise, generator, stop)  # type: ignore[arg-type]
                if stop():
                    break
                labels.save(path, drives)
            found += labels.load(path)
            say(f"{len(found):,} of {config.episodes:,} episodes")
    return found
