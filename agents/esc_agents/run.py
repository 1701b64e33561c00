"""The directory of a run: what it holds, written so that at any instant every file is whole."""

from __future__ import annotations

import csv
import importlib.metadata
import io
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from math import isfinite
from pathlib import Path
from typing import Any

from esc_agents.config import TrainConfig, dump, load_config
from esc_agents.errors import UserError

STEP = "time/total_timesteps"
PACKAGES = ("esc-gym", "highway-env", "gymnasium", "stable-baselines3", "torch", "numpy")


def write_atomically(path: Path, write: Callable[[Any], object]) -> None:
    """Let ``write`` fill a temporary file beside ``path``, then put it in place."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a whole text file atomically."""
    write_atomically(path, lambda file: file.write(text.encode()))


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically; infinities, which JSON does not have, as null."""
    write_text(path, json.dumps(_finite(value), indent=2, allow_nan=False) + "\n")


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def default_run_dir(config: TrainConfig) -> Path:
    """runs/<env>-<repr>-<algo>-<seed>-<time>"""
    representation = config.repr.replace(":", ".")
    stamp = time.strftime("%Y%m%d-%H%M%S")
    return Path("runs") / f"{config.env}-{representation}-{config.algo}-{config.seed}-{stamp}"


def create(path: Path, config: TrainConfig, wrapper: dict[str, Any], device: str = "cpu") -> Path:
    """A new run directory with config.yaml, command.txt, versions.json and wrapper.json.

    device: what the run computes on, for versions.json.
    """
    check_free(path)
    try:
        (path / "checkpoints").mkdir(parents=True)
    except OSError as error:
        raise UserError(f"run directory {path}: {error.strerror}") from error
    note_session(path, config)
    write_json(path / "versions.json", versions() | {"device": device})
    write_json(path / "wrapper.json", wrapper)
    return path


def check_free(path: Path) -> None:
    """Raises UserError where no directory can be made at ``path``."""
    if os.path.lexists(path):
        raise UserError(
            f"run directory {path} already exists; continue that run with esc-train --resume "
            f"{path}, or give another --run-dir"
        )
    parent = next(folder for folder in path.absolute().parents if folder.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise UserError(f"run directory {path}: no directory can be made in {parent}")


def note_session(path: Path, config: TrainConfig) -> None:
    """Keep what this session, the first or one that resumes, is to do, and add its command."""
    write_text(path / "config.yaml", f"# esc-train --config {path}/config.yaml\n{dump(config)}")
    commands = path / "command.txt"
    before = commands.read_text(encoding="utf-8") if commands.is_file() else ""
    write_text(commands, before + shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]) + "\n")


def open_run(path: Path) -> TrainConfig:
    """The configuration of an existing run."""
    if not (path / "config.yaml").is_file():
        raise UserError(f"{path} is no run directory: expected a config.yaml in it")
    return load_config(path / "config.yaml")


def latest_model(path: Path) -> Path:
    """The newest saved model of a run: the one it ended with, or its last checkpoint."""
    found = [*(path / "checkpoints").glob("*.zip"), *path.glob("model.zip")]
    if not found:
        raise UserError(f"{path} holds no model yet: expected model.zip or checkpoints/*.zip")
    return max(found, key=lambda file: file.stat().st_mtime)


def versions() -> dict[str, str]:
    """Python, platform, packages and, in a checkout, the commit."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    root = Path(__file__).parents[2]
    if not (root / "pyproject.toml").is_file():  # installed: a repository around is not ours
        return found
    describe = ["git", "-C", str(root), "describe", "--always", "--dirty"]
    commit = subprocess.run(describe, capture_output=True, text=True, check=False)
    return found | ({"commit": commit.stdout.strip()} if commit.returncode == 0 else {})


class MetricsFile:
    """metrics.csv: one row per log; goes on where an earlier session of the run stopped."""

    def __init__(self, path: Path, first_step: int = 0) -> None:
        """Rows past ``first_step``, logged after the model was saved, are dropped."""
        self.path = path
        self.rows: list[dict[str, Any]] = []
        if path.is_file():
            with path.open(newline="", encoding="utf-8") as file:
                rows = [r for r in csv.DictReader(file) if (r.get(STEP) or "").isdigit()]
            self.rows = [row for row in rows if int(row[STEP]) <= first_step]
            self._rewrite()

    def write(self, row: dict[str, Any]) -> None:
        """Append a row; a new column rewrites the file."""
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
        write_text(self.path, text.getvalue())
