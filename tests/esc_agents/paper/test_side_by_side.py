"""The table: the paper's averages as a check of ours."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from esc_agents.paper.side_by_side import as_csv, entries, published, ratios, roots, rows, savings
from tests.esc_agents.paper.finished import result

ESC, FP, AP = ("esc", "fixed"), ("fp", "fixed"), ("ap", "fixed")


def test_the_papers_own_averages():
    """Its text says 62.2, 67.5 and 20.7 %; the last was recomputed from its table."""
    assert len(published()) == 6 * 4 * 4
    assert savings(published())[1:] == [
        ["ESC against FP", "62.2%", "62.2%", "24 of 24", ""],
        ["ESC against AP", "67.5%", "67.5%", "24 of 24", ""],
        ["FP against AP", "20.7%", "20.7%", "23 of 24", "benchmark 6, M=5: 66 against 65"],
        ["ESC, any M against FP", "63.1%", "63.1%", "24 of 24", ""],
    ]


def test_mean_and_deviation_over_seeds():
    results = [result(1, 5, "esc", seed, error) for seed, error in enumerate((4.0, 16.0))]
    entry = entries(results)[1, 5, *ESC]
    assert (entry.mean, entry.seeds) == (10.0, 2)
    assert entry.std == pytest.approx(np.std([4, 16], ddof=1))
    assert str(entry) == "10±8.5"
    assert entries(results, 0.5)[1, 5, *ESC].mean == 3.0
    assert str(entries(results[:1])[1, 5, *ESC]) == "4"
    assert str(roots(entries(results))[1, 5, *ESC]) == "3.16"


def test_ratios_of_what_both_have():
    cells = (5, "esc", 1.0), (5, "fp", 4.0), (10, "esc", 3.0), (7, "esc", 1.0), (7, "fp", 1.0)
    table = entries([result(1, size, repr, 0, error) for size, repr, error in cells])
    assert ratios(table, ESC, FP) == {(1, 5): 0.25}  # the paper has no sets of seven
    assert ratios(table, ESC, AP) == {}
    assert savings(table)[1:] == [["ESC against FP", "75.0%", "49.2%", "1 of 1", ""]]


def test_best_in_bold_and_more_columns():
    cells = (5, "esc", 1.0), (5, "fp", 4.0), (5, "attention", 0.5), (None, "esc", 2.0)
    table = entries([result(1, size, repr, 0, error) for size, repr, error in cells])
    header, first, *others = rows(table, published())
    assert header[2:] == [
        "ESC, any M", "ESC", "FP", "attention", "paper: ESC, any M", "paper: ESC", "paper: FP",
    ]  # fmt: skip
    assert first[:6] == ["1", "5", "2", "1", "4", "**0.5**"]
    assert first[6:] == ["3.78±0.1", "**3.77±0.15**", "7.42±0.13"]
    assert [row[1] for row in others] == ["10", "15", "20"]


def test_studies_are_not_in_the_table():
    cells = [
        result(1, None, "esc", 0, 9.0, code_dim=5),
        result(1, 20, "fp", 0, 9.0, slots=5),
        result(1, 2, "fp", 0, 9.0, overtaking=[0.0]),
        result(1, 20, "fp", 0, 7.0),
    ]
    assert list(entries(cells)) == [(1, 20, *FP)]
    assert entries(cells)[1, 20, *FP].mean == 7.0


def test_csv():
    text = as_csv([result(2, 10, "ap", seed, 50.0 + seed) for seed in range(2)])
    (row,) = csv.DictReader(text.splitlines())
    assert (row["mse"], row["seeds"], row["paper_mse"]) == ("50.5", "2", "60.14")
    assert float(row["rmse"]) == pytest.approx((50**0.5 + 51**0.5) / 2)
