"""The directory of a run: what it holds, written so that at any instant every file is whole."""

from __future__ import annotations

import csv
import hashlib
import io
import os
import shlex
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np
from filelock import FileLock, Timeout
from numpy.typing import NDArray

from esc_agents import files, strangers
from esc_agents.config import TrainConfig, dump, load_config, scenario_name
from esc_agents.errors import UserError

RESULTS, CHECKSUMS = "results.json", "SHA256SUMS"
STEP = "time/total_timesteps"
IMITATE = "imitate.yaml"
"""What a run of esc-imitate has beside config.yaml."""


def default_run_dir(config: TrainConfig, way: str = "") -> Path:
    """runs/<scenario>-<repr>-<way>-<seed>-<time>; way: of learning, "" for the algorithm."""
    scenario, representation = scenario_name(config), config.repr.replace(":", ".")
    stamp = time.strftime("%Y%m%d-%H%M%S")
    return Path("runs") / f"{scenario}-{representation}-{way or config.algo}-{config.seed}-{stamp}"


def create(
    path: Path, config: TrainConfig, wrapper: dict[str, Any], device: str = "cpu",
    texts: Mapping[str, str] | None = None,
) -> Path:  # fmt: skip
    """A new run directory with config.yaml, command.txt, versions.json and wrapper.json.

    It is there with all of them, or not at all. device: what the run computes on, for
    versions.json. texts: further files, by name.
    """
    check_free(path)
    made = files.temporary_of(path)
    try:
        rmtree(made, ignore_errors=True)  # of a killed process that had our number
        (made / "checkpoints").mkdir(parents=True)
        for name, text in (texts or {}).items():
            files.write_text(made / name, text)
        note_config(made, config, path)
        note_command(made)
        files.write_json(made / "versions.json", files.versions() | {"device": device})
        files.write_json(made / "wrapper.json", wrapper)
        files.put_in_place(made, path)
    except OSError as error:
        raise UserError(f"run directory {path}: {error.strerror}") from error
    finally:
        rmtree(made, ignore_errors=True)
    return path


def resumed_by(path: Path) -> str:
    """The command that continues the run in ``path``."""
    program = "esc-imitate" if (path / IMITATE).exists() else "esc-train"
    return f"{program} --resume {path}"


def learned(path: Path, config: TrainConfig, steps: int) -> str:
    """What the policy in ``path`` learned from, in words."""
    imitated = (path / IMITATE).is_file()
    return f"imitation, {steps:,} labels" if imitated else f"{config.algo}, {steps:,} steps"


def check_free(path: Path) -> None:
    """Raises UserError where no directory can be made at ``path``."""
    if os.path.lexists(path):
        raise UserError(
            f"run directory {path} already exists; continue that run with {resumed_by(path)}, or "
            "give another --run-dir"
        )
    parent = next(folder for folder in path.absolute().parents if folder.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise UserError(f"run directory {path}: no directory can be made in {parent}")


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Keeps other processes out of a run directory. Raises UserError where one is in it."""
    lock = FileLock(path / ".lock")
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise UserError(f"{path} is in use by another process; wait until it has ended") from error
    try:
        for left in list(path.rglob(".*.[0-9]*.tmp")):  # of a process killed while it wrote
            if left.is_dir():
                rmtree(left)
            else:
                left.unlink(missing_ok=True)
        yield
    finally:
        lock.release()


@contextmanager
def said(path: Path, program: str) -> Iterator[None]:
    """What disks and processes do to a run of ``program``, as UserErrors."""
    again = f"continue with {program} --resume {path}"
    try:
        yield
    except (EOFError, ConnectionError) as error:
        sys.stdout.flush()  # where nobody reads that any more, this raises: then it is no process
        raise UserError(
            f"the process of an environment died: killed, or out of memory; {again}"
        ) from error
    except OSError as error:  # full, or not ours to write
        raise UserError(
            f"{error.filename or path}: {error.strerror}; what was written before is whole; once "
            f"that is mended, {again}"
        ) from error


def note_session(path: Path, config: TrainConfig) -> None:
    """Keep what this session, which resumes a run, is to do, and add its command."""
    for name in (CHECKSUMS, RESULTS):  # of a session that has ended; now it is not finished
        (path / name).unlink(missing_ok=True)
    note_config(path, config, path)
    note_command(path)


def note_config(folder: Path, config: TrainConfig, path: Path) -> None:
    """Write config.yaml into ``folder``, which is to be found at ``path``."""
    imitated = (folder / IMITATE).is_file()
    how = f"esc-imitate: {IMITATE}" if imitated else f"esc-train --config {path}/config.yaml"
    text = f"# {how}\n# mac: {strangers.BLANK}\n{dump(config)}"
    files.write_text(folder / "config.yaml", strangers.signed(text))


def note_command(path: Path) -> None:
    """Add the command of this process to command.txt, as it can be given again."""
    module = getattr(getattr(sys.modules["__main__"], "__spec__", None), "name", "")
    ours = module.startswith("esc_agents.")  # python -m, where argv names a file
    program = ["python", "-m", module] if ours else [Path(sys.argv[0]).name]
    commands = path / "command.txt"
    before = commands.read_text(encoding="utf-8") if commands.is_file() else ""
    files.write_text(commands, before + shlex.join([*program, *sys.argv[1:]]) + "\n")


def commands(path: Path) -> list[str]:
    """The commands in command.txt, each once, in their order."""
    noted = path / "command.txt"
    lines = noted.read_text(encoding="utf-8").splitlines() if noted.is_file() else []
    return list(dict.fromkeys(lines))


def open_run(path: Path, trust: bool = False) -> TrainConfig:
    """The configuration of an existing run. trust: as of ``config.load``."""
    if not (path / "config.yaml").is_file():
        raise UserError(f"{path} is no run directory: expected a config.yaml in it")
    verify(path, "config.yaml")
    return load_config(path / "config.yaml", trust)


def finish(path: Path, results: list[dict[str, Any]]) -> None:
    """The last two files of a run: results.json, then SHA256SUMS, with which it is finished."""
    files.write_json(path / RESULTS, results)
    write_checksums(path)


def finished(path: Path) -> bool:
    """Whether a run did all that its config.yaml says, and all of its files are there."""
    return (path / CHECKSUMS).is_file() and (path / RESULTS).is_file()


def write_checksums(path: Path) -> None:
    """SHA256SUMS over the files of a finished run, as ``sha256sum -c`` reads it."""
    found = [file for file in sorted(path.iterdir()) if file.is_file() and file.name[0] != "."]
    lines = [f"{_sha256(file)}  {file.name}\n" for file in found if file.name != CHECKSUMS]
    files.write_text(path / CHECKSUMS, "".join(lines))


def verify(path: Path, *names: str) -> None:
    """Raises UserError where a file is not what it was when the run was finished."""
    try:
        text = (path / CHECKSUMS).read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError):
        return  # not finished
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path / CHECKSUMS} is not readable: {error}") from error
    sums = {name: digest for digest, _, name in (row.partition("  ") for row in text.splitlines())}
    for name in names:
        if name in sums and sums[name] != _sha256(path / name):
            raise UserError(
                f"{path / name} does not match its checksum in {CHECKSUMS}: it was damaged, or "
                "changed since; take the directory again from where it came"
            )


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error


class MetricsFile:
    """metrics.csv: one row per log; goes on where an earlier session of the run stopped."""

    def __init__(self, path: Path, first_step: int = 0) -> None:
        """Rows past ``first_step``, logged after the model was saved, are dropped."""
        self.path = path
        self.rows: list[dict[str, Any]] = []
        if path.is_file():
            # What is not text is in a line that a crash cut off, and such lines are left out.
            with path.open(newline="", encoding="utf-8", errors="replace") as file:
                rows = [r for r in csv.DictReader(file) if (r.get(STEP) or "").isdigit()]
            self.rows = [row for row in rows if int(row[STEP]) <= first_step]
            self._rewrite()

    def write(self, row: dict[str, Any]) -> None:
        """Append a row, or add to the last one where it is of the same step."""
        if self.rows and str(self.rows[-1][STEP]) == str(row[STEP]):
            self.rows[-1].update(row)
            self._rewrite()
            return
        known = self.rows[0].keys() if self.rows else ()
        self.rows.append({**dict.fromkeys(known, ""), **row})
        if len(self.rows[-1]) > len(known):
            self._rewrite()
        else:
            with self.path.open("a", newline="", encoding="utf-8") as file:
                csv.DictWriter(file, list(known)).writerow(self.rows[-1])

    def _rewrite(self) -> None:
        columns = dict.fromkeys(key for row in self.rows for key in row)
        self.rows = [{**dict.fromkeys(columns, ""), **row} for row in self.rows]
        text = io.StringIO()
        table = csv.DictWriter(text, list(columns))
        table.writeheader()
        table.writerows(self.rows)
        files.write_text(self.path, text.getvalue())


def read_metric(directory: Path, name: str) -> list[float]:
    """The values of a column of a run's metrics.csv, in order."""
    with (directory / "metrics.csv").open(newline="", encoding="utf-8") as file:
        return [float(line[name]) for line in csv.DictReader(file) if line.get(name)]


def read_evaluations(path: Path) -> dict[str, NDArray]:
    """The arrays of an evaluations.npz, each as long as ``timesteps``. Raises UserError."""
    try:
        with path.open("rb") as file, np.load(file) as saved:
            arrays = {name: saved[name] for name in saved.files}
        lengths = {len(values) for values in arrays.values()}
        if lengths != {len(arrays["timesteps"])}:
            raise ValueError(f"arrays of different lengths, {sorted(lengths)}")
        return arrays
    except FileNotFoundError:
        raise
    except Exception as error:  # a damaged archive makes NumPy raise almost anything
        raise UserError(f"{path} is damaged: {type(error).__name__}: {error}") from error
