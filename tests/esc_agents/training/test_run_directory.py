import csv
import json
import os
import platform
import sys
from importlib.machinery import ModuleSpec

import pytest

from esc_agents import files
from esc_agents.config import load_config
from esc_agents.errors import UserError
from esc_agents.training import run_directory
from esc_agents.training.run_directory import STEP, MetricsFile
from tests.esc_agents.tiny import tiny


def read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "model.zip"
    files.write_text(path, "old")

    def fail(file):
        file.write(b"half of the new")
        raise RuntimeError("disk full")

    with pytest.raises(RuntimeError, match="disk full"):
        files.write_atomically(path, fail)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["model.zip"]


def test_json_is_standard_json(tmp_path):
    files.write_json(tmp_path / "a.json", {"ttc": float("inf"), "rows": [(1.5, float("nan"))]})

    def refuse(constant):
        raise ValueError(constant)  # Infinity and NaN are no JSON

    text = (tmp_path / "a.json").read_text()
    assert json.loads(text, parse_constant=refuse) == {"ttc": None, "rows": [[1.5, None]]}


def test_metrics_append_and_grow_columns(tmp_path):
    path = tmp_path / "metrics.csv"
    metrics = MetricsFile(path)
    metrics.write({STEP: 1, "a": 0.5})
    metrics.write({STEP: 2, "a": 0.25})
    metrics.write({STEP: 3, "b": "x,y"})
    metrics.write({STEP: 4, "a": 1})
    assert read(path) == [
        {STEP: "1", "a": "0.5", "b": ""},
        {STEP: "2", "a": "0.25", "b": ""},
        {STEP: "3", "a": "", "b": "x,y"},
        {STEP: "4", "a": "1", "b": ""},
    ]


def test_one_row_for_a_step(tmp_path):
    metrics = MetricsFile(tmp_path / "metrics.csv")
    metrics.write({STEP: 1, "a": 0.5})
    metrics.write({STEP: 1, "b": 2})
    assert read(tmp_path / "metrics.csv") == [{STEP: "1", "a": "0.5", "b": "2"}]


def test_metrics_go_on_after_the_step_that_was_saved(tmp_path):
    path = tmp_path / "metrics.csv"
    first = MetricsFile(path)
    for step in (10, 20, 30):
        first.write({STEP: step, "a": step})
    with path.open("a") as file:
        file.write("not a step,")  # a line cut short by a crash
    second = MetricsFile(path, first_step=20)
    second.write({STEP: 25, "c": 1})
    assert [row[STEP] for row in read(path)] == ["10", "20", "25"]
    assert [row["a"] for row in read(path)] == ["10", "20", ""]


def test_a_new_run_directory(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["/usr/bin/esc-train", "--env-config", "{lanes_count: 2}"])
    config = tiny(seed=3)
    path = run_directory.create(tmp_path / "deep" / "run", config, {"max_vehicles": 6}, "abacus")
    assert load_config(path / "config.yaml") == config == run_directory.open_run(path)
    assert (path / "command.txt").read_text() == "esc-train --env-config '{lanes_count: 2}'\n"
    started = ModuleSpec("esc_agents.cli.train", None)  # as python -m has it
    monkeypatch.setattr(sys.modules["__main__"], "__spec__", started)
    monkeypatch.setattr("sys.argv", ["/here/train.py", "--repr", "esc"])
    run_directory.note_command(path)
    last = (path / "command.txt").read_text().splitlines()[-1]
    assert last == "python -m esc_agents.cli.train --repr esc"
    versions = json.loads((path / "versions.json").read_text())
    assert versions["python"] == platform.python_version()
    assert versions["device"] == "abacus"
    assert versions.keys() >= {"torch", "highway-env", "stable-baselines3", "platform"}
    assert json.loads((path / "wrapper.json").read_text()) == {"max_vehicles": 6}
    assert (path / "checkpoints").is_dir()


def test_a_later_session_adds_its_command_and_new_settings(tmp_path, monkeypatch):
    path = run_directory.create(tmp_path / "run", tiny(steps=16), {})
    monkeypatch.setattr("sys.argv", ["esc-train", "--resume", "run"])
    run_directory.note_session(path, tiny(steps=48))
    assert (path / "command.txt").read_text().splitlines()[1:] == ["esc-train --resume run"]
    assert run_directory.open_run(path).steps == 48


def test_nothing_is_overwritten(tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    for name in ("file", "folder", "dangling"):
        with pytest.raises(UserError, match="already exists"):
            run_directory.create(tmp_path / name, tiny(), {})
    with pytest.raises(UserError, match="no directory can be made in"):
        run_directory.create(tmp_path / "file" / "run", tiny(), {})
    assert (tmp_path / "file").read_text() == "mine"
    assert not list((tmp_path / "folder").iterdir())


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_no_write_permission(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(UserError, match="no directory can be made in"):
        run_directory.create(tmp_path / "run", tiny(), {})


def test_checksums_are_those_of_sha256sum(tmp_path):
    (tmp_path / "a.txt").write_text("abc")
    (tmp_path / "folder").mkdir()
    run_directory.write_checksums(tmp_path)
    digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-2, B.1
    assert (tmp_path / "SHA256SUMS").read_text() == f"{digest}  a.txt\n"
    run_directory.verify(tmp_path, "a.txt", "another that is not listed")
    (tmp_path / "a.txt").write_text("abd")
    with pytest.raises(UserError, match=r"a.txt does not match its checksum in SHA256SUMS"):
        run_directory.verify(tmp_path, "a.txt")


def test_a_directory_in_use(tmp_path):
    left = tmp_path / "checkpoints" / ".model.zip.123.tmp"
    left.parent.mkdir()
    left.touch()
    with run_directory.locked(tmp_path):
        assert not left.exists()  # of a process that was killed
        with (
            pytest.raises(UserError, match="is in use by another process"),
            run_directory.locked(tmp_path),
        ):
            pass
    with run_directory.locked(tmp_path):
        pass


def test_default_directories_name_the_run():
    path = run_directory.default_run_dir(tiny(repr="my.module:Class", algo="sac", seed=7))
    assert path.parent.name == "runs"
    assert path.name.startswith("highway-fast-v0-my.module.Class-sac-7-")
    path = run_directory.default_run_dir(load_config("highway-dense"), "imitation")
    assert path.name.startswith("highway-dense-esc-imitation-0-")  # its id is highway-v0


def test_no_run_directory(tmp_path):
    with pytest.raises(UserError, match=r"expected a config.yaml"):
        run_directory.open_run(tmp_path)
