"""esc-paper killed at any instant at which its files change: started again, it ends the same."""

from __future__ import annotations

from dataclasses import replace

from esc_agents.paper.experiment import finished, grid, train_cells
from esc_agents.paper.report import report
from esc_agents.paper.results import read, write
from tests.esc_agents.instants import contents, photographed, restore
from tests.esc_agents.paper.finished import result


def test_cells(tmp_path):
    cells, out = grid([1], [2], ["esc", "fp"], [0]), tmp_path / "cells"
    out.mkdir()

    def found():
        """The results, without what the clock says."""
        return [made and replace(made, seconds=0) for made in (read(out, cell) for cell in cells)]

    def go_on():
        for cell in cells:
            if not finished(cell, 2, out):
                train_cells([cell], 2, "cpu", out)

    with photographed(out, tmp_path / "album") as photos:
        go_on()
    whole = found()
    assert len(photos) == 3  # none, one, both
    for number, photo in enumerate(photos):
        restore(photo, out)
        assert found() == whole[:number] + [None] * (2 - number)
        go_on()
        assert found() == whole


def test_report(tmp_path):
    out = tmp_path / "out"
    (out / "cells").mkdir(parents=True)
    for repr in ("esc", "fp"):
        write(out / "cells", result(1, 5, repr, 0, 3.0))
    with photographed(out, tmp_path / "album") as photos:
        report(out)
    whole = contents(out)
    assert len(photos) == 1 + len(whole) - 3  # the cells and their folder were there
    for photo in photos:
        restore(photo, out)
        report(out)
        assert contents(out) == whole
