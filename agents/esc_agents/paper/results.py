"""Finished cells as files: each written whole and checked when it is read."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from esc_agents.paper.cells import CODE_DIM, INIT, Cell, Point
from esc_agents.reporting import records
from esc_agents.reporting.records import Damaged

SCHEMA = 2


@dataclass(frozen=True)
class Result:
    """A trained cell. points: its errors during training, the last ones after ``updates``.

    seconds: wall time of the training, of one of several at once its share. made_with: device,
    versions and commit.
    overtaking: where M = 2, the policy's output on the sets of ``training.overtaking``.
    """

    cell: Cell
    updates: int
    points: list[Point]
    seconds: float
    made_with: dict[str, str]
    overtaking: list[float] | None = None


def path_of(folder: Path, cell: Cell) -> Path:
    """b<benchmark>-<M or any>-<representation>[-d<d3>][-z<Z>][-<init>]-s<seed>.json"""
    parts = [f"b{cell.benchmark}", "any" if cell.size is None else str(cell.size)]
    parts.append(cell.repr.replace(":", "."))
    if cell.code_dim != CODE_DIM:
        parts.append(f"d{cell.code_dim}")
    if cell.slots is not None:
        parts.append(f"z{cell.slots}")
    if cell.init != INIT:
        parts.append(cell.init)
    return folder / f"{'-'.join(parts)}-s{cell.seed}.json"


def write(folder: Path, result: Result) -> None:
    """Write a cell's file at once: it is there whole, or not at all."""
    records.write(path_of(folder, result.cell), SCHEMA, asdict(result))


def read(folder: Path, cell: Cell, trust: bool = False) -> Result | None:
    """A cell's result, None if it was not trained yet. Raises Damaged. trust: of ``records``."""
    path = path_of(folder, cell)
    if not path.exists():
        return None
    result = read_file(path, trust)
    if result.cell != cell:
        raise Damaged(f"{path}: holds another cell, {result.cell}")
    return result


def read_file(path: Path, trust: bool = False) -> Result:
    """The result in a file. Raises Damaged. trust: of ``records``."""
    record = records.read(path, SCHEMA, trust)
    try:
        points = [
            Point(point["update"], {int(size): e for size, e in point["errors"].items()})
            for point in record.pop("points")
        ]
        return Result(cell=Cell(**record.pop("cell")), points=points, **record)
    except (ValueError, AttributeError, KeyError, TypeError) as error:
        raise Damaged(f"{path}: not a whole result of esc-paper ({error!r})") from error
