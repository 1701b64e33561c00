"""The grid of the paper's table, trained cell by cell; what is finished stays finished."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path
from threading import Event, Thread
from typing import Any

import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from esc_agents import files
from esc_agents.errors import UserError, say
from esc_agents.paper import results
from esc_agents.paper.cells import CODE_DIM, INIT, Cell, overtaking, train
from esc_agents.paper.results import Result
from esc_agents.paper.targets import MAX_VEHICLES
from esc_agents.reporting.records import Damaged
from esc_agents.workers import SPAWN, follow_parent, out_of_reach
from esc_gym.encoders import APEncoder, representation

STUDIES: dict[str, list[dict[str, Any]]] = {
    "code-dim": [
        {"size": None, "repr": "esc", "code_dim": code_dim}
        for code_dim in (1, 5, 26, 51, CODE_DIM, 202)
    ],
    "truncation": [
        *({"size": MAX_VEHICLES, "repr": "fp", "slots": slots} for slots in (1, 5, 10, 15)),
        *({"size": MAX_VEHICLES, "repr": repr} for repr in ("fp", "esc")),
    ],
    "overtaking": [{"size": 2, "repr": repr} for repr in ("fp", "esc")],
}
"""Beyond the table: what a smaller or larger d3 does, what FP loses where it takes only the Z
nearest of twenty vehicles, and how policies answer while two vehicles change places."""

_done: Any = None  # of a worker: work that all of them have done, shared


def grid(
    benchmarks: Sequence[int], sizes: Sequence[int | None], reprs: Sequence[str],
    seeds: Sequence[int],
) -> list[Cell]:  # fmt: skip
    """The cells in the order in which they are trained: a whole table for one seed after the other.

    FP and AP take sets of one size: they have no cell where M varies.
    """
    one_size = {repr for repr in reprs if issubclass(representation(repr), APEncoder)}
    return [
        Cell(benchmark, size, repr, seed)
        for seed, benchmark, size, repr in product(seeds, benchmarks, sizes, reprs)
        if size is not None or repr not in one_size
    ]


def study(name: str, benchmarks: Sequence[int], seeds: Sequence[int]) -> list[Cell]:
    """The cells of one of the ``STUDIES``, all of them for one seed after the other."""
    return [
        Cell(benchmark, seed=seed, **settings)
        for seed, benchmark, settings in product(seeds, benchmarks, STUDIES[name])
    ]


def run(
    cells: Sequence[Cell], updates: int, device: str, workers: int, out: Path, trust: bool = False
) -> None:
    """Train those of ``cells`` that ``out`` does not hold yet, ``workers`` at a time."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {out}: {error.strerror}") from error
    missing = [cell for cell in cells if not finished(cell, updates, out, trust)]
    say(f"{len(cells)} cells, {len(cells) - len(missing)} of them finished, into {out}")
    if not missing:
        return
    done = SPAWN.Value("d", 0.0)
    pool = ProcessPoolExecutor(workers, SPAWN, _start_worker, (done,))
    finished_now = 0
    try:
        with out_of_reach():
            jobs = [
                pool.submit(train_cells, group, updates, device, out)
                for group in groups(missing, together=device != "cpu")
            ]
        with _progress(sum(updates * cost(cell) for cell in missing), done):
            for job in as_completed(jobs):
                for result in job.result():
                    finished_now += 1
                    say(f"[{finished_now}/{len(missing)}] {describe(result)}")
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def groups(cells: Sequence[Cell], together: bool) -> list[list[Cell]]:
    """What is trained at once: with ``together``, cells that differ only in their seeds.

    On a CPU that gains nothing, the products of one cell being large enough; measured: 0.9 to 1.1
    times the time.
    """
    found: dict[Cell, list[Cell]] = {}
    for cell in cells:
        found.setdefault(replace(cell, seed=0) if together else cell, []).append(cell)
    return list(found.values())


def finished(cell: Cell, updates: int, out: Path, trust: bool = False) -> bool:
    """Does ``out`` hold the cell? A damaged file is named, and trained again.

    Raises UserError for a cell that was trained with another number of updates.
    """
    try:
        result = results.read(out, cell, trust)
    except Damaged as damaged:
        say(f"{damaged}; it is trained again")
        return False
    if result and result.updates != updates:
        raise UserError(
            f"--updates {updates}: {results.path_of(out, cell)} was trained with "
            f"{result.updates}; give another --out, or --updates {result.updates}"
        )
    return result is not None


def cost(cell: Cell) -> float:
    """Work of an update, relative to others: rows through h, and through the rest."""
    if issubclass(representation(cell.repr), APEncoder):
        return 2.0
    return 1.0 + (cell.size or (1 + MAX_VEHICLES) / 2)


def train_cells(cells: Sequence[Cell], updates: int, device: str, out: Path) -> list[Result]:
    """Train cells that differ only in their seeds and write their files. Called in a worker."""
    start, work = time.perf_counter(), sum(map(cost, cells))

    def tick(update: int) -> None:
        if _done is not None:
            with _done.get_lock():
                _done.value += work

    trained = train(cells, updates, device, tick)
    seconds = (time.perf_counter() - start) / len(cells)
    made_with = files.versions() | {"device": device}
    found = []
    for cell, (policy, points) in zip(cells, trained, strict=True):
        outputs = None
        if cell.size == 2:
            with torch.no_grad():
                outputs = policy(overtaking(device)[1]).tolist()
        found.append(Result(cell, updates, points, seconds, made_with, outputs))
        results.write(out, found[-1])
    return found


def describe(result: Result) -> str:
    """One line about a finished cell."""
    cell, last = result.cell, result.points[-1].errors
    size = "1..20" if cell.size is None else cell.size
    options = f", d3={cell.code_dim}" if cell.code_dim != CODE_DIM else ""
    options += f", Z={cell.slots}" if cell.slots else ""
    options += f", init {cell.init}" if cell.init != INIT else ""
    errors = ", ".join(f"{error:.4g} at M={m}" for m, error in last.items())
    return (
        f"benchmark {cell.benchmark}, M={size}, {cell.repr}{options}, seed {cell.seed}: "
        f"MSE {errors} "
        f"({result.seconds:.0f} s)"
    )


def _start_worker(done: Any) -> None:
    global _done
    _done = done
    follow_parent()
    torch.set_num_threads(1)


@contextmanager
def _progress(total: float, done: Any) -> Iterator[None]:
    """A bar with the time left, in a terminal."""
    columns = BarColumn(None), TextColumn("{task.percentage:.1f}%"), TimeElapsedColumn()
    with Progress(*columns, TextColumn("left"), TimeRemainingColumn(), transient=True) as bar:
        task, over = bar.add_task("", total=total), Event()

        def follow() -> None:
            while not over.wait(0.5):
                bar.update(task, completed=done.value)

        follower = Thread(target=follow, daemon=True)
        follower.start()
        try:
            yield
        finally:
            over.set()
            follower.join()
