"""Result files: what was written comes back, and what was not is refused."""

from __future__ import annotations

import contextlib
import json

import pytest

from esc_agents.paper.cells import Cell, Point
from esc_agents.paper.results import Result, path_of, read, write
from esc_agents.reporting.records import Damaged

CELL = Cell(2, None, "esc", 3)
POINTS = [Point(100, {5: 7.25, 20: 0.1}), Point(200, {5: 1 / 3, 20: 2.0})]
RESULT = Result(CELL, 200, POINTS, 12.5, {"device": "cpu"})


def test_round_trip(tmp_path):
    assert read(tmp_path, CELL) is None
    write(tmp_path, RESULT)
    assert path_of(tmp_path, CELL).name == "b2-any-esc-s3.json"
    assert read(tmp_path, CELL) == RESULT
    assert [path.name for path in tmp_path.iterdir()] == ["b2-any-esc-s3.json"]


@pytest.mark.parametrize("where", range(0, 400, 23))
def test_one_changed_byte(tmp_path, where):
    write(tmp_path, RESULT)
    path = path_of(tmp_path, CELL)
    content = bytearray(path.read_bytes())
    content[where] ^= 1
    path.write_bytes(content)
    with contextlib.suppress(Damaged):
        assert read(tmp_path, CELL) == RESULT  # a blank that JSON does not mind


@pytest.mark.parametrize("text", ["", "{", "[]", "3", "{}", '{"sha256": 1}', "\x00\xff"])
def test_other_files(tmp_path, text):
    path_of(tmp_path, CELL).write_bytes(text.encode("latin-1"))
    with pytest.raises(Damaged, match="b2-any-esc-s3"):
        read(tmp_path, CELL)


def test_cut_off(tmp_path):
    write(tmp_path, RESULT)
    path = path_of(tmp_path, CELL)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(Damaged):
        read(tmp_path, CELL)


def test_renamed(tmp_path):
    write(tmp_path, RESULT)
    other = Cell(1, None, "esc", 3)
    path_of(tmp_path, CELL).rename(path_of(tmp_path, other))
    with pytest.raises(Damaged, match="holds another cell"):
        read(tmp_path, other)


def test_another_version(tmp_path, monkeypatch):
    monkeypatch.setattr("esc_agents.paper.results.SCHEMA", 99)
    write(tmp_path, RESULT)
    monkeypatch.undo()
    with pytest.raises(Damaged, match="another version"):
        read(tmp_path, CELL)
    assert json.loads(path_of(tmp_path, CELL).read_text())["schema"] == 99
