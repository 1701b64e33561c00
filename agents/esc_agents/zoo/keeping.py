"""Finished runs become agents of the zoo: one run, or the best of a comparison's."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from shutil import copyfile, rmtree

import numpy as np

from esc_agents import pretrained
from esc_agents.compare.analysis import OURS, Task, load
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
RIVAL = "attention"  # kept, too, where it drives better


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
        raise UserError(f"{run} is not finished; continue it with esc-train --resume {run}")
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
    """The agents that a comparison's directory has to give: ESC's, and the rival's where better."""
    found = []
    for task in load(out):
        ours = Kept(task.settings["env"], task, task.runs(OURS), _chosen(task, OURS))
        found.append(ours)
        if RIVAL in task.reprs and np.mean(task.scores(RIVAL)) > np.mean(task.scores(OURS)):
            name = f"{ours.name}-{RIVAL}"
            found.append(Kept(name, task, task.runs(RIVAL), _chosen(task, RIVAL)))
    return found


def _chosen(task: Task, repr: str) -> Result:
    runs = task.runs(repr)
    if not runs:
        raise UserError(f"{task.folder}: expected finished runs of {repr} in it, got none")
    return max(runs, key=lambda run: np.mean(run.curve["results"][-JUDGED:]))
