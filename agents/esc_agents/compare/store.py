"""A comparison's directory: one folder for each scenario and algorithm, one file for each result.

<scenario>-<algorithm>/task.yaml        what all its runs share
                       baselines.json   drivers that learn nothing
                       tuning/*.json    tuning runs
                       results/*.json   runs of the study
                       runs/            directories of esc-train, and what it said; no
                                        checkpoints of finished runs

``trust``, where a function reads: whether files that this user did not write may name code to
import; else they are a UserError.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from math import inf
from pathlib import Path
from typing import Any

import yaml

from esc_agents import files, strangers, yaml_text
from esc_agents.compare.grid import Candidate, Cell, CompareConfig, task_name
from esc_agents.driving.episodes import Episode, Summary, as_rows, summaries
from esc_agents.errors import UserError
from esc_agents.reporting import records
from esc_agents.reporting.records import Damaged

SCHEMA = 1


@dataclass(frozen=True)
class OrderEffect:
    """What another order of the same vehicles did to a policy's decisions.

    decisions: how many were looked at; changed: share of them that came out differently, of
    continuous actions the mean difference; features: largest difference of the features, in
    proportion to the largest feature.
    """

    decisions: int
    changed: float
    features: float


@dataclass(frozen=True)
class Result:
    """A run of the study, trained and measured.

    vehicles: N. slots: Z of fp and ap. parameters: of the features extractor, and of the whole
    policy. config: the training configuration. curve: training steps, returns [k][episodes] and
    crashes of the evaluations on the way; of imitation labels, and regret and blind_regret (see
    imitation.learning.Measured), too. drives: episodes of the final policy by traffic, "" in
    the traffic that it was trained in. shuffled: the same as drives[""], rows in random order.
    churn: share of a policy's slots that hold another vehicle than a step before; None without
    slots. seconds: of training and measuring. made_with: device, versions and commit.
    """

    cell: Cell
    vehicles: int
    slots: int | None
    parameters: tuple[int, int]
    config: dict[str, Any]
    curve: dict[str, list]
    drives: dict[str, list[Episode]]
    shuffled: list[Episode]
    order: OrderEffect
    churn: float | None
    seconds: float
    made_with: dict[str, str]


@dataclass(frozen=True)
class Tuned:
    """A tuning run: the returns of its policy's episodes."""

    cell: Cell
    returns: list[float]
    seconds: float
    made_with: dict[str, str]


@dataclass(frozen=True)
class Baselines:
    """Drivers that learn nothing, on the episodes of the study: blind ones, IDM/MOBIL, a planner.

    missing: why, by name, those that are not there could not drive. planner: also None in what was
    measured before there was one.
    """

    blind: dict[str, Summary]
    rule: Summary | None
    made_with: dict[str, str]
    missing: dict[str, str] = field(default_factory=dict)
    planner: Summary | None = None


def task_folder(out: Path, cell: Cell) -> Path:
    """Where everything of a scenario and algorithm lies."""
    return out / cell.task


def path_of(out: Path, cell: Cell) -> Path:
    """The result file of a run."""
    folder = task_folder(out, cell)
    return folder / ("tuning" if cell.tuning else "results") / f"{cell.name}.json"


def run_folder(out: Path, cell: Cell) -> Path:
    """The run directory of a run."""
    name = f"tuning-{cell.name}" if cell.tuning else cell.name
    return task_folder(out, cell) / "runs" / name


def write(out: Path, result: Result | Tuned) -> None:
    """Write a run's file at once: it is there whole, or not at all."""
    path = path_of(out, result.cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    content = asdict(result)
    if isinstance(result, Result):
        content["drives"] = {name: _columns(drives) for name, drives in result.drives.items()}
        content["shuffled"] = _columns(result.shuffled)
    records.write(path, SCHEMA, content)


def read(out: Path, cell: Cell, trust: bool = False) -> Result | Tuned | None:
    """A run's result, None where there is none yet. Raises UserError for a damaged one."""
    path = path_of(out, cell)
    if not path.exists():
        return None
    with _told(path):
        result = _read(path, Tuned if cell.tuning else Result, trust)
        if (result.cell.task, result.cell.name) != (cell.task, cell.name):
            raise Damaged(f"{path}: holds another run, {result.cell.name}")
        return result


def results(folder: Path, trust: bool = False) -> list[Result]:
    """All results of the study in a task's folder. Raises UserError for a damaged one."""
    return [_whole(path, Result, trust) for path in sorted((folder / "results").glob("*.json"))]


def tuned(folder: Path, trust: bool = False) -> list[Tuned]:
    """All tuning runs in a task's folder. Raises UserError for a damaged one."""
    return [_whole(path, Tuned, trust) for path in sorted((folder / "tuning").glob("*.json"))]


def write_baselines(folder: Path, baselines: Baselines) -> None:
    """Write a task's baselines."""
    content = {**asdict(baselines), "blind": as_rows(baselines.blind)}
    records.write(folder / "baselines.json", SCHEMA, content)


def baselines(folder: Path, trust: bool = False) -> Baselines | None:
    """A task's baselines, None where there are none yet. Raises UserError for damaged ones."""
    path = folder / "baselines.json"
    if not path.exists():
        return None
    with _told(path):
        content = records.read(path, SCHEMA, trust)
        for name in ("rule", "planner"):
            if found := content.get(name):
                content |= summaries([{"policy": name, **found}])
        content["blind"] = summaries(content["blind"])
        return Baselines(**content)


def check_folder(out: Path) -> None:
    """Raises UserError for the directory of a training run."""
    if (out / "config.yaml").exists() and not any(task_folders(out)):
        raise UserError(f"--out {out}: is the directory of a training run; give another")


def begin_task(out: Path, config: CompareConfig, env: str, trust: bool = False) -> None:
    """Note what all runs of a scenario share. Raises UserError where it is not what it was."""
    if check_task(out, config, env, trust):
        return
    path = out / task_name(env, config.way) / "task.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    text = f"# mac: {strangers.BLANK}\n{yaml_text.dump(_shared(config, env))}"
    files.write_text(path, strangers.signed(text))


def _shared(config: CompareConfig, env: str) -> dict[str, Any]:
    """What all runs of a scenario share."""
    transfer = config.transfer.get(env, {})
    return {"env": env, "algo": config.way, **config.fixed(), "transfer": transfer}


def check_task(out: Path, config: CompareConfig, env: str, trust: bool = False) -> bool:
    """Whether a scenario is begun. Raises UserError where it was begun with other settings."""
    path = out / task_name(env, config.way) / "task.yaml"
    if not path.exists():
        return False
    found, asked = task_settings(path.parent, trust), _shared(config, env)
    for key in {**found, **asked}:
        if found.get(key) != asked.get(key):
            raise UserError(
                f"{path}: begun with {key}={found.get(key)!r}, now asked for with "
                f"{asked.get(key)!r}; ask for the same, or give another --out"
            )
    return True


def task_settings(folder: Path, trust: bool = False) -> dict[str, Any]:
    """What ``begin_task`` noted. Raises UserError where it is damaged."""
    path = folder / "task.yaml"
    try:
        data = path.read_bytes()
        settings = yaml_text.parse(data.decode())
        if not isinstance(settings, dict):
            raise ValueError("no mapping in it")
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise UserError(f"{path} is damaged: {error}") from error
    strangers.check(path, data, settings, trust)
    return settings


def task_folders(out: Path) -> Iterator[Path]:
    """The folders of a comparison that hold a task, by name."""
    yield from (path.parent for path in sorted(out.glob("*/task.yaml")))


def _whole(path: Path, type_: Any, trust: bool) -> Any:
    with _told(path):
        return _read(path, type_, trust)


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """What a damaged file raises, as a UserError that names it."""
    try:
        yield
    except (Damaged, KeyError, TypeError, ValueError, AttributeError) as error:
        what = str(error) if isinstance(error, Damaged) else f"{path} is damaged: {error!r}"
        raise UserError(f"{what}; remove it and start again, and it is made anew") from error


def _read(path: Path, type_: type[Result] | type[Tuned], trust: bool) -> Any:
    content = records.read(path, SCHEMA, trust)
    cell = content.pop("cell")
    cell["candidate"] = Candidate(**cell["candidate"])
    content["cell"] = Cell(**cell)
    if type_ is Result:
        content["drives"] = {name: _episodes(rows) for name, rows in content["drives"].items()}
        content["shuffled"] = _episodes(content["shuffled"])
        content["order"] = OrderEffect(**content["order"])
        content["parameters"] = tuple(content["parameters"])
    return type_(**content)


def _columns(episodes: list[Episode]) -> dict[str, list]:
    """Episodes as columns, of which a file is a third as long."""
    names = [field.name for field in fields(Episode)]
    return {name: [getattr(episode, name) for episode in episodes] for name in names}


def _episodes(columns: dict[str, list]) -> list[Episode]:
    """JSON has null for no time to collision."""
    columns = {**columns, "min_ttc": [inf if v is None else v for v in columns["min_ttc"]]}
    rows = zip(*columns.values(), strict=True)
    return [Episode(**dict(zip(columns, row, strict=True))) for row in rows]
