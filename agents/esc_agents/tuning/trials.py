"""One run of a search, and the file in which it ends.

<out>/tune.yaml           what all trials share
     trials/*.json        runs of the search
     finals/*.json        runs of the finalists
     runs/                directories of esc-train, and what it said
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from esc_agents import files
from esc_agents.compare.jobs import JUDGED, Post, session, train_into
from esc_agents.errors import UserError
from esc_agents.reporting import records
from esc_agents.training.run_directory import read_evaluations
from esc_agents.tuning.settings import Parameters, TuneConfig, train_config

SCHEMA = 1
SPARED = 2  # evaluations at the beginning of a run, at which none is pruned
STARTUP = 4  # finished trials that there have to be before one is pruned


class Pruned(Exception):
    """A run that is not worth going on with."""


@dataclass(frozen=True)
class Tried:
    """What became of a run.

    timesteps, returns, crashed: of its evaluations, means over their episodes. pruned: ended
    early. problem: why it could not be run at all. made_with: device, versions and commit.
    """

    number: int
    parameters: Parameters
    seed: int
    timesteps: list[int]
    returns: list[float]
    crashed: list[float]
    pruned: bool
    problem: str
    seconds: float
    made_with: dict[str, str]

    @property
    def value(self) -> float | None:
        """What the search maximises: the mean return of its last evaluations."""
        whole = self.returns and not self.pruned and not self.problem
        return float(np.mean(self.returns[-JUDGED:])) if whole else None


def path_of(out: Path, number: int, seed: int | None = None) -> Path:
    """The file of a trial, or of a finalist's run."""
    if seed is None:
        return out / "trials" / f"{number:03d}.json"
    return out / "finals" / f"{number:03d}-s{seed}.json"


def read(path: Path, trust: bool = False) -> Tried | None:
    """A run's file; None where there is none. Raises UserError where it is damaged."""
    if not path.exists():
        return None
    try:
        return Tried(**records.read(path, SCHEMA, trust))
    except (records.Damaged, TypeError) as damaged:
        raise UserError(f"{damaged}; remove it, and it is made anew") from damaged


def write(path: Path, tried: Tried) -> None:
    """Write a run's file at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    records.write(path, SCHEMA, asdict(tried))


def bars(tried: Sequence[Tried]) -> tuple[float, ...]:
    """The median of what whole trials had at best up to each of their evaluations; () for none."""
    whole = [t.returns for t in tried if t.value is not None]
    if len(whole) < STARTUP:
        return ()
    length = min(map(len, whole))
    best = np.maximum.accumulate([returns[:length] for returns in whole], axis=1)
    return tuple(np.median(best, axis=0).tolist())


@dataclass(frozen=True)
class TrialJob:
    """Trains a run of a trial, from its last checkpoint if it has one.

    seed: of a finalist's run; None in the search. bars: of ``bars``. trust: whether what others
    wrote into its directory may run code.
    """

    config: TuneConfig
    number: int
    parameters: Parameters
    seed: int | None = None
    bars: tuple[float, ...] = ()
    trust: bool = False

    @property
    def name(self) -> str:
        kind = "trial" if self.seed is None else "final"
        return f"{kind} {path_of(Path(), self.number, self.seed).stem}"

    @property
    def steps(self) -> int:
        return self._train_config().steps

    def _train_config(self) -> Any:
        return train_config(self.config, self.parameters, self.seed or 0, self.seed is not None)

    def files(self, out: Path) -> list[Path]:
        path = path_of(out, self.number, self.seed)
        return [out / "runs" / f"{path.parent.name}-{path.stem}", path]

    def do(self, out: Path, post: Post) -> None:
        pruned = False
        folder, path = self.files(out)
        with session(folder) as seconds:
            judge = _Judge(folder / "evaluations.npz", self.bars)
            try:
                train_into(self._train_config(), folder, post, self.name, self.trust, [judge])
            except Pruned:
                pruned = True
            rmtree(folder / "checkpoints", ignore_errors=True)
            saved = read_evaluations(folder / "evaluations.npz")
            tried = partial(Tried, self.number, self.parameters, self.seed or 0)
            write(path, tried(
                saved["timesteps"].tolist(), saved["results"].mean(axis=1).tolist(),
                saved["crashed"].mean(axis=1).tolist(), pruned, "", seconds(), files.versions(),
            ))  # fmt: skip


class _Judge(BaseCallback):
    """Ends a run whose best evaluation is below the bar that stands there."""

    def __init__(self, path: Path, bars: Sequence[float]) -> None:
        super().__init__()
        self.path, self.bars, self.count = path, bars, 0

    def _on_rollout_start(self) -> None:
        if not self.bars or not self.path.is_file():
            return
        returns = read_evaluations(self.path)["results"].mean(axis=1)
        count = min(len(returns), len(self.bars))
        if count > max(self.count, SPARED):
            self.count = count
            if returns[:count].max() < self.bars[count - 1]:
                raise Pruned

    def _on_step(self) -> bool:
        return True
