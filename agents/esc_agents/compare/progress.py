"""The whole grid while it runs: a live table in a terminal, else a line for each finished run."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import isnan
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from esc_agents.compare.engines import Engine
from esc_agents.compare.jobs import BaselineJob, Interrupted, Job, Progress, TrainJob
from esc_agents.errors import UserError, reason, say

COLUMNS = ("", "runs", "steps", "return", "crashes", "steps/s", "left")


@dataclass
class _Row:
    """All runs of a representation in a scenario. total, steps: training steps."""

    runs: int = 0
    done: int = 0
    total: int = 0
    begun: float | None = None
    posts: dict[str, Progress] = field(default_factory=dict)

    @property
    def steps(self) -> int:
        return sum(post.steps for post in self.posts.values())

    def mean(self, name: str) -> float | None:
        values = [getattr(post, name) for post in self.posts.values()]
        values = [value for value in values if not isnan(value)]
        return sum(values) / len(values) if values else None


class Board:
    """What is told of jobs while an engine runs them.

    steps: of each training job. failed: jobs and what they raised.
    """

    def __init__(self, title: str, jobs: Sequence[Job], steps: dict[str, int]) -> None:
        self.title, self.steps = title, steps
        self.count, self.ended = len(jobs), 0
        self.failed: list[tuple[Job, BaseException]] = []
        self.rows: dict[str, _Row] = {}
        for job in jobs:
            row = self.rows.setdefault(_label(job), _Row())
            row.runs += 1
            row.total += steps.get(job.name, 0)
        self._labels = {job.name: _label(job) for job in jobs}
        self._resumed: dict[str, int] = {}  # steps with which a run was first heard of
        self._start = time.monotonic()
        console = Console()
        self._live = Live(console=console, get_renderable=self.table, refresh_per_second=2)
        self._shown = console.is_terminal

    def __enter__(self) -> Board:
        if self._shown:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            self._live.stop()

    def post(self, progress: Progress) -> None:
        """Where a run stands."""
        row = self.rows[self._labels[progress.name]]
        if progress.name not in self._resumed:
            self._resumed[progress.name] = progress.steps
        row.begun = row.begun or time.monotonic()
        row.posts[progress.name] = progress

    def done(self, job: Job, error: BaseException | None) -> None:
        """A job has ended."""
        self.ended += 1
        row = self.rows[_label(job)]
        if error is None:
            row.done += 1
            steps, last = self.steps.get(job.name, 0), row.posts.get(job.name)
            if last is None or last.steps < steps:
                self.post(Progress(job.name, steps))
        else:
            self.failed.append((job, error))
        what = "done" if error is None else f"failed: {error or type(error).__name__}"
        if self._shown:
            if error is not None:
                self._live.console.print(f"{job.name}: {what}", markup=False, highlight=False)
        else:
            say(f"[{self.ended}/{self.count}] {job.name}: {what}")

    def left(self) -> float | None:
        """Seconds until the grid is trained, at the rate until now; None before anything is."""
        gained = sum(row.steps for row in self.rows.values()) - sum(self._resumed.values())
        if gained <= 0:
            return None
        missing = sum(row.total - row.steps for row in self.rows.values())
        return max(0.0, missing) * (time.monotonic() - self._start) / gained

    def table(self) -> Table:
        """As it is now."""
        table = Table(title=f"{self.title}: {self.ended} of {self.count}", title_justify="left")
        for column in COLUMNS:
            if column:  # numbers in full; where there is no room, names fold
                table.add_column(column, justify="right", no_wrap=True, min_width=len(column))
            else:
                table.add_column(column, overflow="fold")
        for label, row in self.rows.items():
            table.add_row(label, f"{row.done}/{row.runs}", *self._numbers(row))
        left = self.left()
        table.add_row("all", f"{self.ended}/{self.count}", *[""] * 4, _clock(left), style="bold")
        return table

    def _numbers(self, row: _Row) -> list[str]:
        if not row.total:
            return [""] * 5
        reward, crashed = row.mean("reward"), row.mean("crashed")
        took = time.monotonic() - row.begun if row.begun else 0.0
        gained = row.steps - sum(self._resumed.get(name, 0) for name in row.posts)
        rate = gained / took if took > 1 else None
        left = (row.total - row.steps) / rate if rate else None
        return [
            f"{row.steps / 1000:.0f}k/{row.total / 1000:.0f}k",
            "" if reward is None else f"{reward:.2f}",
            "" if crashed is None else f"{crashed:.0%}",
            "" if rate is None or row.done == row.runs else f"{rate:.0f}",
            "" if row.done == row.runs else _clock(left),
        ]


def _label(job: Job) -> str:
    if isinstance(job, TrainJob):
        cell: Any = job.cell
        return f"{cell.env} {cell.repr}{f' ({cell.traffic})' if cell.traffic else ''}"
    return f"{job.env} baselines" if isinstance(job, BaselineJob) else job.name


def _clock(seconds: float | None) -> str:
    if seconds is None:
        return ""
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02} min" if minutes >= 60 else f"{minutes} min"


def run_jobs(
    title: str, jobs: Sequence[Job], steps: dict[str, int], out: Path, engine: Engine
) -> None:
    """Run jobs and show how they do. steps: of those that train, by name.

    Raises UserError if one failed, once the others are through; KeyboardInterrupt if interrupted.
    """
    if not jobs:
        return
    with Board(title, jobs, steps) as board:
        engine.run(jobs, out, board.done, board.post)
    failed = [(job, error) for job, error in board.failed if not isinstance(error, Interrupted)]
    if failed:
        job, error = failed[0]
        raise UserError(
            f"{len(failed)} of {len(jobs)} jobs failed, the rest is kept; the first is {job.name}: "
            f"{reason(error)}"
        )
    if board.failed:
        raise KeyboardInterrupt
