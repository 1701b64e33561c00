"""One piece of a comparison's work, done in whatever process an engine gives it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from shutil import rmtree
from typing import Any, Protocol, TypeVar

import numpy as np
from filelock import FileLock, Timeout
from stable_baselines3.common.callbacks import BaseCallback

from esc_agents import files
from esc_agents.compare import store
from esc_agents.compare.grid import (
    EPISODES,
    Cell,
    CompareConfig,
    imitate_config,
    run_config,
    scenario,
    task_name,
)
from esc_agents.compare.measure import baselines, drive, encoder_of, examine
from esc_agents.compare.store import Result, Tuned
from esc_agents.config import TrainConfig
from esc_agents.driving.policies import load_policy
from esc_agents.errors import UserError
from esc_agents.imitation.imitate import imitate, open_imitation
from esc_agents.imitation.settings import ImitateConfig
from esc_agents.training import run_directory
from esc_agents.training.run_directory import read_evaluations, read_metric
from esc_agents.training.train import train
from esc_gym.encoders import APEncoder
from esc_gym.matching import parameter_count

C = TypeVar("C", TrainConfig, ImitateConfig)
REGRETS = "regret", "blind_regret"
JUDGED = 3  # evaluations at the end of a tuning run, whose returns count
PATIENCE = 60.0  # s to wait for a process that was killed and has not yet let go of its run


@dataclass(frozen=True)
class Progress:
    """Where a run stands. reward, crashed: means over its last training episodes, NaN before."""

    name: str
    steps: int
    reward: float = float("nan")
    crashed: float = float("nan")


Post = Callable[[Progress], object]


class Interrupted(Exception):
    """Somebody asked to stop; what was done is kept."""


class Job(Protocol):
    """Picklable work; its files are in ``out`` when ``do`` returns."""

    @property
    def name(self) -> str: ...

    def files(self, out: Path) -> list[Path]:
        """Files and folders that the job makes, last the one with which it is done."""
        ...

    def do(self, out: Path, post: Post) -> None: ...


@dataclass(frozen=True)
class TrainJob:
    """Trains a run, from its last checkpoint if it has one, and measures its policy.

    trust: whether what others wrote into its directory may run code.
    """

    config: CompareConfig
    cell: Cell
    slots: int
    trust: bool = False

    @property
    def name(self) -> str:
        return f"{self.cell.task}/{'tuning/' if self.cell.tuning else ''}{self.cell.name}"

    def files(self, out: Path) -> list[Path]:
        return [store.run_folder(out, self.cell), store.path_of(out, self.cell)]

    def do(self, out: Path, post: Post) -> None:
        config, folder = run_config(self.config, self.cell, self.slots), self.files(out)[0]
        with session(folder) as seconds:
            if self.config.learn == "imitate":
                labelled = imitate_config(self.config, self.cell, self.slots)
                imitate_into(labelled, folder, post, self.name, self.trust)
                rmtree(folder / "labels", ignore_errors=True)  # some 100 MB
            else:
                train_into(config, folder, post, self.name, self.trust)
            # Of no use any more, and with SAC's replay buffer hundreds of MB for each run. Before
            # the result, since who has that is not asked again.
            rmtree(folder / "checkpoints", ignore_errors=True)
            if self.cell.tuning:
                saved = read_evaluations(folder / "evaluations.npz")
                returns = saved["results"][-JUDGED:].ravel().tolist()
                store.write(out, Tuned(self.cell, returns, seconds(), files.versions()))
            else:
                store.write(out, self._measured(config, folder, seconds))

    def _measured(self, config: TrainConfig, folder: Path, seconds: Callable[[], float]) -> Result:
        cell, episodes = self.cell, range(EPISODES, EPISODES + self.config.episodes)
        policy, _ = load_policy(folder, "cpu", trust=self.trust)
        encoder = encoder_of(policy)
        slots = encoder.slots if isinstance(encoder, APEncoder) else None
        vehicles = encoder.max_vehicles
        own, order, churn = examine(config, policy, episodes)
        drives = {"": own}
        for traffic in ("", *self.config.transfer.get(cell.env, {})):
            if traffic != cell.traffic:
                other = scenario(self.config, cell.env, traffic)
                fields = {"repr": config.repr, "algo": config.algo, "seed": config.seed}
                drives[traffic or "as it is"] = drive(
                    other.model_copy(update=fields), policy, episodes
                )
        shuffled = drive(config, policy, episodes, shuffle=True)
        saved = read_evaluations(folder / "evaluations.npz")
        curve = {name: saved[name].tolist() for name in ("timesteps", "results", "crashed")}
        if self.config.learn == "imitate":
            curve |= {name: read_metric(folder, f"imitation/{name}") for name in REGRETS}
        return Result(
            cell, vehicles, slots, (parameter_count(encoder), parameter_count(policy)),
            config.model_dump(mode="json"), curve, drives, shuffled, order, churn,
            seconds(), files.versions(),
        )  # fmt: skip


@dataclass(frozen=True)
class BaselineJob:
    """Drives a scenario without learning anything."""

    config: CompareConfig
    env: str

    @property
    def name(self) -> str:
        return f"{task_name(self.env, self.config.way)}/baselines"

    def files(self, out: Path) -> list[Path]:
        return [out / task_name(self.env, self.config.way) / "baselines.json"]

    def do(self, out: Path, post: Post) -> None:
        found = baselines(scenario(self.config, self.env), EPISODES, self.config.episodes)
        (path,) = self.files(out)
        path.parent.mkdir(parents=True, exist_ok=True)
        store.write_baselines(path.parent, found)


@contextmanager
def session(folder: Path) -> Iterator[Callable[[], float]]:
    """Work on a run, whose output goes into a file beside its directory.

    Yields what says how many seconds it has taken, with those of sessions that were interrupted.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    log = folder.with_name(f"{folder.name}.log").open("a", encoding="utf-8")
    noted = folder.with_name(f"{folder.name}.seconds")
    start = time.perf_counter() - (float(noted.read_text()) if noted.is_file() else 0.0)
    with log, redirect_stdout(log), redirect_stderr(log):
        try:
            yield lambda: time.perf_counter() - start
        except Interrupted:
            files.write_text(noted, str(time.perf_counter() - start))
            raise
        noted.unlink(missing_ok=True)


def train_into(
    config: TrainConfig, folder: Path, post: Post, name: str, trust: bool,
    listeners: Sequence[BaseCallback] = (),
) -> None:  # fmt: skip
    """Train into ``folder``, or go on there; nothing where it is done. Raises Interrupted."""
    listeners = [_Listener(name, post), *listeners]

    def learn(config: TrainConfig, resume: Path | None) -> bool:
        return train(config, resume=resume, trust=trust, listeners=listeners)

    _learn_into(folder, config, learn, partial(run_directory.open_run, trust=trust))


def imitate_into(config: ImitateConfig, folder: Path, post: Post, name: str, trust: bool) -> None:
    """The same, from labels."""

    def learn(config: ImitateConfig, resume: Path | None) -> bool:
        return imitate(config, resume, trust, lambda labels: post(Progress(name, labels)))

    _learn_into(folder, config, learn, partial(open_imitation, trust=trust))


def _learn_into(
    folder: Path, config: C, learn: Callable[[C, Path | None], bool], open_run: Callable[[Path], C]
) -> None:
    if folder.exists():
        if not (folder / "config.yaml").exists():
            raise UserError(
                f"{folder} is no run directory: expected a config.yaml in it; remove it, and its "
                "run is done anew"
            )
        _wait_until_free(folder)
        begun = open_run(folder)
        if begun.model_copy(update={"run_dir": None}) != config:
            raise UserError(
                f"{folder} was trained with other settings; remove it, and its run is done anew"
            )
        if run_directory.finished(folder):
            run_directory.verify(folder, "policy.json", "policy.safetensors", "evaluations.npz")
            return
        finished = learn(begun, folder)
    else:
        finished = learn(config.model_copy(update={"run_dir": folder}), None)
    if not finished:
        raise Interrupted


def _wait_until_free(folder: Path) -> None:
    try:
        with FileLock(folder / ".lock", timeout=PATIENCE):
            pass
    except Timeout as error:
        raise UserError(f"{folder} is in use by another process") from error


class _Listener(BaseCallback):
    """Posts where a training stands, about once a second."""

    def __init__(self, name: str, post: Post) -> None:
        super().__init__()
        self.name, self.post, self.next = name, post, 0.0

    def _on_rollout_end(self) -> None:
        if time.monotonic() >= self.next:
            self.next = time.monotonic() + 1.0
            self._tell()

    def _on_training_end(self) -> None:
        self._tell()

    def _tell(self) -> None:
        episodes: Any = self.model.ep_info_buffer or ()
        means = [
            float(np.mean([e[key] for e in episodes])) if episodes else float("nan")
            for key in ("r", "crashed")
        ]
        self.post(Progress(self.name, self.num_timesteps, *means))

    def _on_step(self) -> bool:
        return True


def collected(paths: list[Path], out: Path) -> dict[str, bytes]:
    """Files, and all files in folders, by their place in ``out``, each folder's checksums last."""
    found = {}
    for path in paths:
        inside = sorted(path.rglob("*"), key=lambda file: file.name == run_directory.CHECKSUMS)
        for file in [path] if path.is_file() else inside:
            if file.is_file() and file.name != ".lock":
                found[os.path.relpath(file, out)] = file.read_bytes()
    return found
