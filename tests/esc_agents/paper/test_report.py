"""The report: every figure with what it shows in words, and what is left out."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import numpy as np
import pytest

from esc_agents.errors import UserError
from esc_agents.paper import figures
from esc_agents.paper.cells import Cell, overtaking
from esc_agents.paper.experiment import STUDIES, study
from esc_agents.paper.report import report
from esc_agents.paper.results import path_of, write
from esc_agents.paper.side_by_side import entries
from tests.esc_agents.paper.finished import result

FIGURES = {"bars", "curves-1", "places-1", "truncation-1", "code-dim-1"}


def everything(folder, seeds=2):
    """Cells of the table and of all studies, of benchmark 1."""
    j = overtaking()[0].numpy()
    smooth, jump = 0.01 * j, 0.01 * j + 3.0 * (j > 1.001)
    cells = [Cell(1, 20, repr, seed) for repr in ("esc", "fp", "ap") for seed in range(seeds)]
    for name in STUDIES:
        cells += study(name, [1], range(seeds))
    for cell in dict.fromkeys(cells):
        outputs = (jump if cell.repr == "fp" else smooth).tolist() if cell.size == 2 else None
        made = result(
            1, cell.size, cell.repr, cell.seed, 5.0 + cell.seed, overtaking=outputs,
            code_dim=cell.code_dim, slots=cell.slots,
        )  # fmt: skip
        write(folder, made)


@pytest.fixture
def cells(tmp_path):
    folder = tmp_path / "cells"
    folder.mkdir()
    return folder


def test_files(cells):
    write(cells, result(2, 10, "ap", 1, 51.0))
    report(cells.parent)
    assert "| 2 | 10 | **51** | **60.1±0.36** |" in (cells.parent / "report.md").read_text()
    assert (
        "95 of the paper's 96 entries are not there yet" in (cells.parent / "report.md").read_text()
    )
    assert "glorot,2,10,ap,fixed,51.0" in (cells.parent / "table.csv").read_text()


def test_a_damaged_cell_is_named_and_never_averaged_in(cells):
    write(cells, result(2, 10, "ap", 1, 51.0))
    report(cells.parent)
    before = (cells.parent / "report.md").read_text()
    broken = path_of(cells, Cell(2, 10, "ap", 0))
    write(cells, result(2, 10, "ap", 0, 50.0))
    broken.write_bytes(broken.read_bytes()[:-20])
    with pytest.raises(UserError, match=rf"{broken}: not a whole record.*trains it again"):
        report(cells.parent)
    assert (cells.parent / "report.md").read_text() == before


class Page(HTMLParser):
    """What a browser would meet: open elements, images, cells of tables."""

    def __init__(self, text):
        super().__init__()
        self.open, self.images, self.cells = [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        if tag == "img":
            self.images.append(dict(attrs))
        if tag not in {"meta", "link", "img"}:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in {"td", "th"}:
            self.cells.append(data)


def test_one_page_with_everything(cells, capsys):
    everything(cells)
    report(cells.parent)
    assert {path.stem for path in cells.parent.glob("*.png")} == FIGURES
    text = (cells.parent / "report.html").read_text()
    page = Page(text)
    assert page.open == []
    assert len(page.images) == len(FIGURES)
    assert all(image["alt"] for image in page.images)
    assert all(image["src"].startswith("data:image/png;base64,") for image in page.images)
    assert not re.search(r'(src|href)="https?:', text)
    assert "5.5±0.71" in text
    assert "ESC, any M" in page.cells
    assert re.search(r"largest change .*: 0.0002 \(ESC\), 3 \(FP\)", text)
    printed = capsys.readouterr().out
    assert "5.5" in printed
    assert "±" not in printed


def test_another_initialisation_has_a_table_of_its_own(cells):
    write(cells, result(1, 5, "esc", 0, 3.0))
    write(cells, result(1, 5, "esc", 0, 4.0, init="torch"))
    report(cells.parent)
    ours, other = (cells.parent / "report.md").read_text().split("With the initialisation of torch")
    assert "| 1 | 5 | **3** |" in ours
    assert "| 1 | 5 | **4** |" in other
    lines = (cells.parent / "table.csv").read_text().splitlines()
    assert [line[:24] for line in lines[1:]] == [
        "glorot,1,5,esc,fixed,3.0",
        "torch,1,5,esc,fixed,4.0,",
    ]


def test_studies_alone(cells):
    for cell in study("code-dim", [3], [0]):
        write(cells, result(3, None, "esc", 0, 5.0, code_dim=cell.code_dim))
    report(cells.parent)
    assert "| 26 | 5 |" in (cells.parent / "report.md").read_text()


def test_bands_are_intervals_over_seeds():
    errors = [2.0, 3.0, 7.0]
    results = [result(1, 5, "fp", seed, error) for seed, error in enumerate(errors)]
    axes = figures.curves(results, 1).axes[0]
    assert axes.lines[0].get_ydata()[-1] == pytest.approx(4.0)
    last = [y for x, y in axes.collections[0].get_paths()[0].vertices if x == 100]
    # Student's t with two degrees of freedom: 4.303 standard errors.
    half = 4.303 * np.std(errors, ddof=1) / 3**0.5
    assert (min(last), max(last)) == pytest.approx((4 - half, 4 + half), rel=1e-3)


def test_bars_stand_beside_the_papers():
    table = entries([result(1, 5, repr, 0, error) for repr, error in (("esc", 1.0), ("fp", 4.0))])
    figure = figures.bars(table)
    axes = figure.axes[0]
    assert [bar.get_height() for bar in axes.patches] == [1.0, 4.0]
    diamonds = [line.get_xydata().tolist() for line in axes.lines]
    middles = [bar.get_x() + bar.get_width() / 2 for bar in axes.patches]
    expected = [[middles[0], 3.77]], [[middles[1], 7.42]]
    np.testing.assert_allclose(diamonds, expected)
    named = {text.get_text() for text in figure.legends[0].get_texts()}
    assert named == {"ESC", "FP", "the paper's"}


def test_nothing_to_report(tmp_path):
    with pytest.raises(UserError, match="found none"):
        report(tmp_path)
