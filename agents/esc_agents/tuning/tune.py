"""The whole search: what is missing is trained, round after round, then the report is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from esc_agents import files, yaml_text
from esc_agents.compare.engines import Engine
from esc_agents.compare.progress import run_jobs
from esc_agents.config import SCHEMA
from esc_agents.driving.checks import check
from esc_agents.errors import UserError, say
from esc_agents.training.run_directory import locked, note_command
from esc_agents.tuning import trials
from esc_agents.tuning.report import write_report
from esc_agents.tuning.search import as_known, choose, distributions
from esc_agents.tuning.settings import Parameters, TuneConfig, scenario, train_config
from esc_agents.tuning.trials import TrialJob, Tried

SHARED = "tune.yaml"


def tune(config: TuneConfig, out: Path, engine: Engine, trust: bool = False) -> None:
    """Do what ``out`` does not hold yet, and write its report.

    trust: whether what others wrote into ``out`` may run code. Raises UserError.
    """
    distributions(config)
    check(scenario(config))
    if out.exists() and not out.is_dir():
        raise UserError(f"--out {out}: expected a directory")
    try:
        out.mkdir(parents=True, exist_ok=True)
        with locked(out):
            _begin(config, out)
            note_command(out)
            tried = _search(config, out, engine, trust)
            finals = _finals(config, tried, out, engine, trust)
            write_report(config, tried, finals, out)
    except OSError as error:  # full, or not ours to write
        raise UserError(f"--out {error.filename or out}: {error.strerror}") from error


def _begin(config: TuneConfig, out: Path) -> None:
    path, mine = out / SHARED, {"schema": SCHEMA, **config.fixed()}
    if not path.exists():
        files.write_text(path, yaml_text.dump(mine))
        return
    try:
        theirs: Any = yaml_text.parse(path.read_text(encoding="utf-8"))
        differing = [key for key in mine if mine[key] != theirs.get(key)]
    except (yaml.YAMLError, AttributeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: not readable as YAML: {error}") from error
    if differing:
        key = differing[0]
        raise UserError(
            f"--out {out} holds a search with {key} {theirs.get(key)!r}, got {mine[key]!r}; take "
            "another directory"
        )


def _search(config: TuneConfig, out: Path, engine: Engine, trust: bool) -> list[Tried]:
    """All trials, the missing ones of each round trained now."""
    tried: list[Tried] = []
    while len(tried) < config.trials:
        count = min(config.round, config.trials - len(tried))
        known = [as_known(config, t.parameters, t.value, t.returns) for t in tried]
        chosen = enumerate(choose(config, known, count), len(tried))
        bars = trials.bars(tried) if config.prune else ()
        jobs = [TrialJob(config, number, parameters, None, bars, trust)
                for number, parameters in chosen]  # fmt: skip
        _run(f"Trials {len(tried)} to {len(tried) + count - 1}", jobs, out, engine)
        tried += [_read(job, out) for job in jobs]
        values = {t.number: t.value for t in tried if t.value is not None}
        if values:
            best = max(values, key=lambda number: values[number])
            say(f"{len(tried)} trials; best: {values[best]:.2f}, trial {best}; as the scenario is: "
                f"{values.get(0, float('nan')):.2f}")  # fmt: skip
    return tried


def _finals(
    config: TuneConfig, tried: list[Tried], out: Path, engine: Engine, trust: bool
) -> list[Tried]:
    """Runs of the best trials and of the scenario's own settings, in full."""
    if not config.finalists:
        return []
    ranked = sorted((t for t in tried if t.value is not None), key=lambda t: -(t.value or 0.0))
    chosen = list(dict.fromkeys([0, *(t.number for t in ranked[: config.finalists])]))
    jobs = [
        TrialJob(config, number, tried[number].parameters, seed, (), trust)
        for seed in range(config.seeds)
        for number in chosen
    ]
    _run("Finalists", jobs, out, engine)
    return [_read(job, out) for job in jobs]


def _read(job: TrialJob, out: Path) -> Tried:
    found = trials.read(job.files(out)[1], job.trust)
    if found is None or found.parameters != job.parameters:
        raise UserError(
            f"{job.files(out)[1]}: of other settings, or gone; remove it, and its run is done anew"
        )
    return found


def _run(title: str, jobs: list[TrialJob], out: Path, engine: Engine) -> None:
    """Train those without a result; those that cannot be trained have theirs at once."""
    missing = []
    for job in jobs:
        if trials.read(job.files(out)[1], job.trust) is not None:
            continue
        if problem := _problem(job.config, job.parameters):
            nothing = [], [], [], False, problem, 0.0, files.versions()
            trials.write(job.files(out)[1], Tried(job.number, job.parameters, 0, *nothing))
            continue
        missing.append(job)
    run_jobs(title, missing, {job.name: job.steps for job in missing}, out, engine)


def _problem(config: TuneConfig, parameters: Parameters) -> str:
    """Why settings cannot be trained with, "" if they can: a batch may exceed a rollout."""
    try:
        check(train_config(config, parameters, 0))
    except UserError as error:
        return str(error)
    return ""
