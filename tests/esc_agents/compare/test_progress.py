"""What people see of a running grid."""

from types import SimpleNamespace
from typing import Any

from rich.console import Console

from esc_agents.compare import progress
from esc_agents.compare.grid import Cell
from esc_agents.compare.jobs import BaselineJob, Progress, TrainJob
from tests.esc_agents.compare.small import ENV, small

CELLS = [Cell(ENV, "ppo", repr, seed) for seed in (0, 1) for repr in ("esc", "fp")]
JOBS: list[Any] = [TrainJob(small(), cell, 6) for cell in CELLS] + [BaselineJob(small(), ENV)]
STEPS = {job.name: 1000 for job in JOBS[:-1]}


def lines(board, width=100) -> dict[str, list[str]]:
    """The cells of the table's rows, by the first."""
    console = Console(width=width)
    with console.capture() as printed:
        console.print(board.table())
    rows = [line.split("│")[1:-1] for line in printed.get().splitlines() if "│" in line]
    return {row[0].strip(): [cell.strip() for cell in row[1:]] for row in rows}


def test_the_whole_grid(monkeypatch):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock.now)
    board = progress.Board("Study", JOBS, STEPS)
    assert lines(board)["all"] == ["0/5", "", "", "", "", ""]
    board.post(Progress(JOBS[0].name, 0))
    clock.now += 10
    board.post(Progress(JOBS[0].name, 500, reward=4.0, crashed=0.5))
    found = lines(board)
    # 500 steps in 10 s; 500 and 1000 are left here, 3500 in all.
    assert found[f"{ENV} esc"] == ["0/2", "0k/2k", "4.00", "50%", "50", "0 min"]
    assert found[f"{ENV} fp"] == ["0/2", "0k/2k", "", "", "", ""]
    assert found[f"{ENV} baselines"] == ["0/1", "", "", "", "", ""]
    assert found["all"] == ["0/5", "", "", "", "", "1 min"]


def test_what_a_resumed_run_had_is_no_speed_of_ours(monkeypatch):
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock.now)
    board = progress.Board("Study", JOBS[:1], STEPS)
    board.post(Progress(JOBS[0].name, 900))
    assert board.left() is None
    clock.now = 10.0
    board.post(Progress(JOBS[0].name, 950))
    assert board.left() == 10.0


def test_what_ended_is_said(capsys):
    board = progress.Board("Study", JOBS, STEPS)
    with board:
        board.done(JOBS[1], None)
        board.done(JOBS[2], ValueError("no"))
    assert capsys.readouterr().out == (
        f"[1/5] {ENV}-ppo/fp-s0: done\n[2/5] {ENV}-ppo/esc-s1: failed: no\n"
    )
    assert lines(board)[f"{ENV} fp"][:2] == ["1/2", "1k/2k"]
    assert [(job.name, str(error)) for job, error in board.failed] == [(JOBS[2].name, "no")]
