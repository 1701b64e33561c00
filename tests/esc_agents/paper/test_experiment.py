"""esc-paper: the grid, what is kept and what is trained again, and what users get wrong."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from esc_agents.cli import paper as cli
from esc_agents.errors import UserError
from esc_agents.paper.cells import Cell
from esc_agents.paper.experiment import cost, grid, groups, study
from esc_agents.paper.results import path_of, read

SMALL = ["--benchmarks", "1", "--cases", "5", "--repr", "fp", "esc", "--updates", "4"]
SCRIPT = "import sys; from esc_agents.cli.paper import main; main()"


def test_the_papers_grid():
    cells = grid(range(1, 7), [5, 10, 15, 20, None], ["esc", "fp", "ap"], range(5))
    assert len(cells) == len(set(cells)) == 6 * (4 * 3 + 1) * 5
    assert {cell.repr for cell in cells if cell.size is None} == {"esc"}
    assert [cell.seed for cell in cells[:78]] == [0] * 78  # one whole table first


def test_costs_grow_with_the_rows_that_are_encoded():
    assert cost(Cell(1, 5, "fp", 0)) == cost(Cell(1, 20, "ap", 0))
    assert cost(Cell(1, 5, "fp", 0)) < cost(Cell(1, 5, "esc", 0)) < cost(Cell(1, None, "esc", 0))
    assert cost(Cell(1, None, "esc", 0)) < cost(Cell(1, 20, "esc", 0))


def test_what_is_trained_at_once():
    cells = grid([1, 2], [5], ["esc", "fp"], range(3))
    assert groups(cells, together=False) == [[cell] for cell in cells]
    together = groups(cells, together=True)
    assert sorted(map(len, together)) == [3] * 4
    for group in together:
        assert len({(cell.benchmark, cell.size, cell.repr) for cell in group}) == 1
        assert [cell.seed for cell in group] == [0, 1, 2]


def test_studies_go_below_at_and_above_the_rule():
    dims = {cell.code_dim for cell in study("code-dim", [1], [0])}
    assert min(dims) < 101 < max(dims)
    assert 101 in dims
    assert len(set(study("truncation", [1, 2], range(2)))) == 6 * 4


def test_finished_cells_are_kept_and_damaged_ones_trained_again(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(  # threads: processes would import torch three times over
        "esc_agents.paper.experiment.ProcessPoolExecutor",
        lambda workers, *_: ThreadPoolExecutor(workers),
    )
    arguments = ["run", *SMALL, "--seeds", "2", "--workers", "2", "--out", str(tmp_path)]
    assert cli.command(arguments) == 0
    assert "4 cells, 0 of them finished" in capsys.readouterr().out
    cells = grid([1], [5], ["fp", "esc"], range(2))
    first = [read(tmp_path / "cells", cell) for cell in cells]
    kept, broken = path_of(tmp_path / "cells", cells[0]), path_of(tmp_path / "cells", cells[3])
    before = kept.stat().st_mtime_ns
    broken.write_bytes(broken.read_bytes()[:50])
    with pytest.raises(UserError, match=f"{broken.name}: not a whole record.*trains it again"):
        cli.command(["report", "--out", str(tmp_path)])
    assert cli.command(arguments) == 0
    printed = capsys.readouterr().out
    assert "4 cells, 3 of them finished" in printed
    assert f"{broken}: not a whole record" in printed
    assert "it is trained again" in printed
    assert kept.stat().st_mtime_ns == before
    again = [read(tmp_path / "cells", cell) for cell in cells]
    assert [result.points for result in again] == [result.points for result in first]
    assert cli.command(["report", "--out", str(tmp_path)]) == 0
    assert "| 1 | 5 |" in (tmp_path / "report.md").read_text()
    with pytest.raises(UserError, match="was trained with 4; give another --out, or --updates 4"):
        cli.command(["run", *SMALL[:-1], "9", "--out", str(tmp_path)])


@pytest.mark.slow
def test_killed_and_started_again(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    grid_of_three = ["--benchmarks", "1", "--cases", "5", "--repr", "fp", "--seeds", "3"]
    arguments = ["run", *grid_of_three, "--updates", "10", "--workers", "1", "--out"]
    start = [sys.executable, "-c", SCRIPT, *arguments]
    subprocess.run([*start, str(whole)], check=True, capture_output=True)
    process = subprocess.Popen(
        [*start, str(killed)], stdout=subprocess.DEVNULL, start_new_session=True
    )
    while not list(killed.glob("cells/b*.json")):
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert 0 < len(list(killed.glob("cells/b*.json"))) < 3
    subprocess.run([*start, str(killed)], check=True, capture_output=True)
    for cell in grid([1], [5], ["fp"], range(3)):
        assert read(killed / "cells", cell).points == read(whole / "cells", cell).points


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "expected run or report, got ''"),
        (["train"], "expected run or report, got 'train'"),
        (["run", "--benchmarks", "7"], "less than or equal to 6"),
        (["run", "--cases", "0"], "expected 1 to 20 vehicles, or any; got '0'"),
        (["run", "--cases", "21"], "expected 1 to 20 vehicles, or any; got '21'"),
        (["run", "--cases", "all"], "got 'all'"),
        (["run", "--quick", "--seeds", "3"], "--quick sets --benchmarks"),
        (["run", "--study", "truncation", "--cases", "5"], "--study truncation sets --cases"),
        (["run", "--study", "jump"], "--study"),
        (["run", "--repr", "esk"], "did you mean 'esc'?"),
        (["run", "--repr"], "at least one"),
        (["run", "--seeds", "0"], "greater than 0"),
        (["run", "--out", "file"], "--out file/cells: Not a directory"),
        (["run", "--bench", "1"], "--bench"),
        (["run", "--device", "tpu"], "--device"),
        (["run", "--device", "cuda"], "--device cuda: torch finds no GPU"),
        (["report", "--out", "nowhere"], "found none"),
    ],
)
def test_user_errors(arguments, message, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr(sys, "argv", ["esc-paper", *arguments])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("esc-paper")
    assert message in error
    assert error.count("\n") == 1


def test_help(capsys):
    assert cli.command(["--help"]) == 0
    printed = capsys.readouterr().out
    assert "usage: esc-paper run|report" in printed
    assert "Finished cells are kept" in printed
