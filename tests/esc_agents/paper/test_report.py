"""The table: the paper's averages as a check of ours, and what is left out."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from esc_agents.errors import UserError
from esc_agents.paper.report import entries, published, reduction, report, rows, savings
from esc_agents.paper.results import Result, path_of, write
from esc_agents.paper.training import Cell, Point


def result(benchmark, size, repr, seed, error):
    cell = Cell(benchmark, size, repr, seed)
    errors = dict.fromkeys(cell.test_sizes, error)
    return Result(cell, 100, [Point(50, dict.fromkeys(errors, 99.0)), Point(100, errors)], 1.0, {})


def test_the_papers_own_averages():
    """Its text says 62.2 %; the others were recomputed from its table."""
    assert len(published()) == 6 * 4 * 4
    shares = {title: (ours, paper) for title, ours, paper in savings(published())[1:]}
    assert shares == {
        "ESC (fixed M) against FP": ("62.2%", "62.2%"),
        "ESC (fixed M) against AP": ("67.5%", "67.5%"),
        "FP against AP": ("20.7%", "20.7%"),
        "ESC (M in 1..20) against FP": ("63.1%", "63.1%"),
    }


def test_mean_and_deviation_over_seeds():
    found = entries([result(1, 5, "esc", seed, error) for seed, error in enumerate((2.0, 4.0))])
    entry = found[1, 5, "esc", "fixed"]
    assert (entry.mean, entry.seeds) == (3.0, 2)
    assert entry.std == pytest.approx(np.std([2, 4], ddof=1))
    assert str(entry) == "3 ± 1.4"
    assert str(entries([result(1, 5, "esc", 0, 2.0)])[1, 5, "esc", "fixed"]) == "2"


def test_reduction_of_what_both_have():
    table = entries([result(1, 5, "esc", 0, 1.0), result(1, 5, "fp", 0, 4.0),
                     result(1, 10, "esc", 0, 3.0)])  # fmt: skip
    assert reduction(table, ("esc", "fixed"), ("fp", "fixed")) == 0.75
    assert np.isnan(reduction(table, ("esc", "fixed"), ("ap", "fixed")))


def test_best_in_bold_and_more_columns():
    cells = (5, "esc", 1.0), (5, "fp", 4.0), (5, "attention", 0.5), (None, "esc", 2.0)
    table = entries([result(1, size, repr, 0, error) for size, repr, error in cells])
    header, first, *others = rows(table)
    assert header[2:6] == [
        "esc (M in 1..20)", "esc (M fixed)", "fp (M fixed)", "attention (M fixed)",
    ]  # fmt: skip
    assert first[:6] == ["1", "5", "2", "1", "4", "**0.5**"]
    assert first[6:10] == ["3.78 ± 0.1", "**3.77 ± 0.15**", "7.42 ± 0.13", ""]
    assert [row[1] for row in others] == ["10", "15", "20"]


def test_files(tmp_path, capsys):
    for seed in range(2):
        write(tmp_path, result(2, 10, "ap", seed, 50.0 + seed))
    broken = path_of(tmp_path, Cell(2, 10, "ap", 0))
    broken.write_bytes(broken.read_bytes()[:-20])
    report(tmp_path)
    assert f"{broken}: not a whole result" in capsys.readouterr().out
    (row,) = csv.DictReader((tmp_path / "table.csv").read_text().splitlines())
    assert (row["mse"], row["seeds"], row["paper_mse"]) == ("51.0", "1", "60.14")
    assert float(row["rmse"]) == pytest.approx(51**0.5)
    assert "| 2 | 10 | **51** |" in (tmp_path / "table.md").read_text()


def test_nothing_to_report(tmp_path):
    with pytest.raises(UserError, match="found none"):
        report(tmp_path)
