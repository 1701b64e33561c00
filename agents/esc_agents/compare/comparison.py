"""The whole comparison: what is missing is trained and measured, then the report is written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from esc_agents.compare import store
from esc_agents.compare.analysis import tuning_scores
from esc_agents.compare.engines import Engine
from esc_agents.compare.estimate import costs
from esc_agents.compare.grid import (
    Candidate,
    Cell,
    CompareConfig,
    candidates,
    check_transfer,
    imitate_config,
    run_config,
    scenario,
    sources,
    study_cells,
    train_config,
    tuning_cells,
)
from esc_agents.compare.jobs import BaselineJob, Job, TrainJob
from esc_agents.compare.progress import run_jobs
from esc_agents.compare.report import write_report
from esc_agents.driving.checks import check
from esc_agents.errors import UserError, say
from esc_agents.imitation.imitate import read_data
from esc_agents.pretrained import run_of
from esc_agents.reporting.tables import show, terminal
from esc_agents.training.run_directory import finished, locked, note_command
from esc_gym.encoders import APEncoder, representation


@dataclass(frozen=True)
class Plan:
    """What is to be done.

    vehicles: N of each scenario. slots: Z of fp and ap there. tuning, study: all runs, finished or
    not. trust: whether what others wrote into the output directory may run code.
    """

    config: CompareConfig
    vehicles: dict[str, int]
    slots: dict[str, int]
    tuning: list[Cell]
    study: list[Cell]
    trust: bool

    def steps(self, cell: Cell) -> int:
        """Training steps of a run."""
        return run_config(self.config, cell, self.slots[cell.env]).steps

    def length(self, cell: Cell) -> str:
        """The same for a table: with a data set, labels beside those in it."""
        steps, config = self.steps(cell), self.config
        if config.learn != "imitate" or not config.imitate.get("data"):
            return f"{steps:,}"
        more = steps - imitate_config(config, cell, self.slots[cell.env]).labels
        return f"its data + {more:,}" if more else "its data"

    def jobs(self, cells: Sequence[Cell]) -> list[Job]:
        """What trains them."""
        return [TrainJob(self.config, cell, self.slots[cell.env], self.trust) for cell in cells]


def plan(config: CompareConfig, trust: bool = False) -> Plan:
    """Looks at everything that a user can get wrong. Raises UserError."""
    check_transfer(config)
    if config.imitate and config.learn != "imitate":
        raise UserError("imitate: expected --learn imitate beside it")
    vehicles = {}
    for env in config.env:
        for traffic in config.transfer.get(env, {}):
            check(scenario(config, env, traffic))
        for repr in config.repr:
            probe = check(scenario(config, env).model_copy(update={"repr": repr}))
            space: Any = probe.observation_space
            vehicles[env] = space["vehicles"].shape[0]
            if config.learn == "imitate":
                imitate_config(config, Cell(env, config.way, repr, 0), vehicles[env])
    slots = {env: min(config.slots or n, n) for env, n in vehicles.items()}
    return Plan(config, vehicles, slots, tuning_cells(config), study_cells(config), trust)


def check_sources(planned: Plan, out: Path) -> None:
    """Raises UserError where what a run that is still to be done begins with is not there."""
    config, seen = planned.config, set()
    for cell in unfinished([*planned.tuning, *planned.study], out, planned.trust):
        slots = planned.slots[cell.env]
        data = imitate_config(config, cell, slots).data if config.learn == "imitate" else None
        if data and (cell.env, data) not in seen:
            seen.add((cell.env, data))
            run = run_config(config, cell, slots)
            read_data(data, run, check(run))
        for source in sources(config, cell, slots):
            if not finished(run_of(source)):
                why = "; tuning has seeds of its own: leave it out, tuning.seeds 0" * cell.tuning
                raise UserError(f"{cell.name}: expected a finished run in {source}{why}")


def compare(config: CompareConfig, out: Path, engine: Engine, trust: bool = False) -> None:
    """Do what ``out`` does not hold yet, and write its report. trust: as of ``Plan``."""
    store.check_folder(out)
    planned = plan(config, trust)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with locked(out):
            _compare(planned, out, engine)
    except OSError as error:  # full, or not ours to write
        raise UserError(f"--out {error.filename or out}: {error.strerror}") from error


def _compare(planned: Plan, out: Path, engine: Engine) -> None:
    config, trust = planned.config, planned.trust
    check_sources(planned, out)
    for env in config.env:
        store.begin_task(out, config, env, trust)
    note_command(out)
    unfinished(planned.study, out, trust)  # a damaged result is said before anything is trained
    tasks = [BaselineJob(config, env) for env in config.env]
    jobs: list[Job] = [
        job for job in tasks if store.baselines(job.files(out)[0].parent, trust) is None
    ]
    jobs += planned.jobs(unfinished(planned.tuning, out, trust))
    _run("Baselines and tuning", jobs, planned, out, engine)
    chosen = [replace(cell, candidate=choice(planned, cell, out)) for cell in planned.study]
    jobs = planned.jobs(unfinished(chosen, out, trust))
    say(f"{len(chosen)} runs, {len(chosen) - len(jobs)} of them finished, into {out}")
    _run("Study", jobs, planned, out, engine)
    write_report(out, trust)


def unfinished(cells: Sequence[Cell], out: Path, trust: bool = False) -> list[Cell]:
    """Those without a result yet."""
    return [cell for cell in cells if store.read(out, cell, trust) is None]


def choice(planned: Plan, cell: Cell, out: Path) -> Candidate:
    """The candidate of highest mean return for a representation in a scenario."""
    tried = candidates(planned.config.tuning)
    if len(tried) == 1:
        return tried[0]
    tuned = store.tuned(store.task_folder(out, cell), planned.trust)
    scores = tuning_scores(tuned, cell.repr, tried)
    return max(scores, key=lambda candidate: scores[candidate])


def _run(title: str, jobs: Sequence[Job], planned: Plan, out: Path, engine: Engine) -> None:
    steps = {job.name: planned.steps(job.cell) for job in jobs if isinstance(job, TrainJob)}
    run_jobs(title, jobs, steps, out, engine)


def dry_run(config: CompareConfig, out: Path, workers: int, trust: bool = False) -> None:
    """Print the grid, and what it will take on this machine. trust: as of ``Plan``."""
    store.check_folder(out)
    planned = plan(config, trust)
    check_sources(planned, out)
    for env in config.env:
        store.check_task(out, config, env, trust)
    unit = "labels" if config.learn == "imitate" else "steps"
    rows = [["", "N", "Z", "tuning runs", "runs", "finished", f"{unit} each"]]
    for env, repr in product(config.env, config.repr):
        tuning, study = (
            [cell for cell in cells if (cell.env, cell.repr) == (env, repr)]
            for cells in (planned.tuning, planned.study)
        )
        finished = len(study) - len(unfinished(study, out, trust))
        slots = planned.slots[env] if issubclass(representation(repr), APEncoder) else ""
        sizes = (planned.vehicles[env], slots, len(tuning), len(study), finished)
        rows.append([f"{env} {repr}", *map(str, sizes), planned.length(study[0])])
    show(terminal(rows, "Grid"))
    if config.learn == "imitate":
        say("Imitation: how long an expert takes is not estimated.")
        return
    seconds, memory = 0.0, 0
    todo: dict[str, dict[str, list[Cell]]] = {}
    for cell in unfinished([*planned.tuning, *planned.study], out, trust):
        todo.setdefault(cell.env, {}).setdefault(cell.repr, []).append(cell)
    for env, missing in todo.items():
        runs = [train_config(config, cells[0], planned.slots[env]) for cells in missing.values()]
        for (repr, cells), found in zip(missing.items(), costs(runs), strict=True):
            say(f"{env} {repr}: {found.steps:,.0f} training steps/s")
            seconds += sum(map(planned.steps, cells)) / found.steps
            memory = max(memory, found.memory)
    say(
        f"Training: {seconds / 3600:.1f} h of one core, {seconds / 3600 / workers:.1f} h with "
        f"{workers} workers; evaluations come on top. Memory: {workers * memory / 2**30:.1f} GiB."
    )
