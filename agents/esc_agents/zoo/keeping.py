"""Finished runs become agents of the zoo: one run, or the best of a comparison's."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from shutil import copyfile, rmtree

import numpy as np

from esc_agents import pretrained
from esc_agents.compare.analysis import Task, load
from esc_agents.compare.jobs import JUDGED
from esc_agents.compare.store import Result
from esc_agents.driving.episodes import Summary
from esc_agents.driving.policies import DESCRIPTION, WEIGHTS
from esc_agents.errors import UserError
from esc_agents.training import run_directory

KEPT = (
    "config.yaml", "command.txt", "versions.json", "wrapper.json", "results.json", WEIGHTS,
    DESCRIPTION,
)  # fmt: skip
RIVALS = "esc-exp", "attention"  # kept, too, where they drive better than ESC


@dataclass(frozen=True)
class Kept:
    """An agent, and how it was found.

    runs: of its scenario and representation, by seed; chosen: the one that is kept, which was the
    best at its own evaluations in training, not on the episodes that are reported.
    """

    name: str
    task: Task
    runs: list[Result]
    chosen: Result

    @property
    def summary(self) -> Summary:
        """All final policies on all episodes."""
        return Summary.of([episode for run in self.runs for episode in run.drives[""]])


def keep(run: Path, name: str) -> Path:
    """Copy what drives out of ``run`` into the zoo, in place of what was called ``name`` there.

    Raises UserError, and changes nothing, for what is no whole run, or no name of a folder.
    """
    if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", name):
        raise UserError(f"name: expected words as in highway-dense, got {name!r}")
    config = run_directory.open_run(run)
    if not run_directory.finished(run):
        raise UserError(f"{run} is not finished; continue it with {run_directory.resumed_by(run)}")
    run_directory.verify(run, *KEPT)
    folder = pretrained.folder() / name
    rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for file in (*KEPT, run_directory.IMITATE):
        if file in KEPT or (run / file).exists():
            copyfile(run / file, folder / file)
    run_directory.note_config(folder, config, Path("zoo") / name)
    run_directory.write_checksums(folder)
    return folder


def best_of(out: Path) -> list[Kept]:
    """The agents that a comparison's directory has to give: ESC's, and rivals' where better."""
    found = []
    for task in load(out):
        name = task.settings["env"]
        found.append(Kept(name, task, task.runs("esc"), _chosen(task, "esc")))
        for rival in RIVALS:
            if rival in task.reprs and np.mean(task.scores(rival)) > np.mean(task.scores("esc")):
                chosen = _chosen(task, rival)
                found.append(Kept(f"{name}-{rival}", task, task.runs(rival), chosen))
    return found


def _chosen(task: Task, repr: str) -> Result:
    runs = task.runs(repr)
    if not runs:
        raise UserError(f"{task.folder}: expected finished runs of {repr} in it, got none")
    return max(runs, key=lambda run: np.mean(run.curve["results"][-JUDGED:]))
