"""The file of a checkpoint: whole or refused, and nobody else's code runs from it."""

from __future__ import annotations

import json
import os
import pickle
import re

import pytest
from hypothesis import given, strategies as st

from esc_agents.errors import UserError
from esc_agents.training import checkpoint
from esc_agents.training.checkpoint import Damaged, in_order, read, write

STATE = pickle.dumps({"weights": list(range(100))})


def test_what_was_written_comes_back(tmp_path):
    path = write(tmp_path, 1500, STATE)
    assert path.name == "000000001500.checkpoint"
    assert read(path) == STATE
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_the_last_two_stay(tmp_path):
    for steps in (10, 20, 300, 4000):
        write(tmp_path, steps, STATE)
    assert [int(path.stem) for path in in_order(tmp_path)] == [300, 4000]


@pytest.mark.parametrize("keep", [0, 1, 30, -1])
def test_cut_off(tmp_path, keep):
    path = write(tmp_path, 1, STATE)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(Damaged, match=r"000000000001.checkpoint is (no whole checkpoint|cut off)"):
        read(path)


def test_a_flipped_bit_is_never_loaded(tmp_path):
    path = write(tmp_path, 1, STATE)
    content = path.read_bytes()
    for place in range(0, len(content), 7):
        changed = bytearray(content)
        changed[place] ^= 4
        path.write_bytes(changed)
        try:
            assert read(path) == STATE  # where the bit is of what is not needed, the versions say
        except (Damaged, UserError):
            continue


@given(content=st.binary(max_size=300))
def test_no_other_file_is_one(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("any") / "1.checkpoint"
    path.write_bytes(content)
    with pytest.raises(Damaged):
        read(path)


def test_another_schema(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "SCHEMA", 7)
    path = write(tmp_path, 1, STATE)
    monkeypatch.undo()
    with pytest.raises(UserError, match=r"expected a checkpoint of schema 1, got 7.*esc-gym 0"):
        read(path)


class Planted:
    """Unpickled, it makes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_somebody_elses_needs_trust(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "their home"))
    path = write(tmp_path, 1, pickle.dumps(Planted(tmp_path / "ran")))
    monkeypatch.undo()
    with pytest.raises(UserError, match=r"not written by you on this machine.*add --trust"):
        read(path)
    assert not (tmp_path / "ran").exists()
    pickle.loads(read(path, trust=True))
    assert (tmp_path / "ran").exists()  # the plant would have worked


def test_a_forged_checksum_is_not_enough(tmp_path):
    """Contents and checksum changed together, by somebody who has not our key."""
    path = write(tmp_path, 1, STATE)
    line, _, _ = path.read_bytes().partition(b"\n")
    theirs = pickle.dumps(Planted(tmp_path / "ran"))
    header = json.loads(line) | {"size": len(theirs), "sha256": checkpoint.sha256(theirs)}
    path.write_bytes(json.dumps(header).encode() + b"\n" + theirs)
    with pytest.raises(UserError, match="add --trust"):
        read(path)


def test_the_key_is_secret_and_stays(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    path = write(tmp_path, 1, STATE)
    (key,) = (tmp_path / "esc_gym").iterdir()
    assert key.stat().st_mode & 0o777 == 0o600
    assert len(key.read_bytes()) == 32
    assert read(path) == STATE


def test_a_full_disk_is_said_and_training_goes_on(tmp_path, monkeypatch):
    said = []
    writer = checkpoint.Writer(tmp_path, said.append)
    writer.write(10, STATE)
    writer.wait()

    def full(path, fill):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("esc_agents.files.write_atomically", full)
    writer.write(20, STATE)
    writer.wait()
    (line,) = said
    assert re.search(r"step 20 could not be written \(No space left.*that of step 10 stands", line)
    assert read(*in_order(tmp_path)) == STATE
