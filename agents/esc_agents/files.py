"""Files that are there whole or not at all, and the versions that belong beside them."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import subprocess
from collections.abc import Callable
from math import isfinite
from pathlib import Path
from typing import Any

WIDTH = 100  # of a line of JSON, unless an array of plain values needs more
PACKAGES = ("esc-gym", "highway-env", "gymnasium", "stable-baselines3", "torch", "numpy")


def write_atomically(path: Path, write: Callable[[Any], object]) -> None:
    """Let ``write`` fill a temporary file beside ``path``, then put it in place."""
    temporary = temporary_of(path)
    try:
        with temporary.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        put_in_place(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def temporary_of(path: Path) -> Path:
    """Where this process makes what is to be at ``path``."""
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def put_in_place(temporary: Path, path: Path) -> None:
    """Rename a file or folder that is whole now."""
    os.replace(temporary, path)
    if hasattr(os, "O_DIRECTORY"):  # the new name, too, has to survive a power cut
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def write_text(path: Path, text: str) -> None:
    """Write a whole text file atomically."""
    write_atomically(path, lambda file: file.write(text.encode()))


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically; infinities, which JSON does not have, as null."""
    write_text(path, json_text(finite(value)) + "\n")


def json_text(value: Any, indent: int = 0) -> str:
    """JSON for people: an array of plain values is one line, all else fills lines of WIDTH."""
    if isinstance(value, dict):
        items = [f"{json.dumps(str(k))}: {json_text(v, indent + 1)}" for k, v in value.items()]
        opening, closing = "{}"
    elif isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
        items = [json_text(item, indent + 1) for item in value]
        opening, closing = "[]"
    else:
        return json.dumps(value, allow_nan=False)
    line = f"{opening}{', '.join(items)}{closing}"
    if "\n" not in line and indent + len(line) <= WIDTH:
        return line
    rows: list[str] = []
    for item in items:
        together = f"{rows[-1]}, {item}" if rows else item
        if "\n" not in together and indent + len(together) < WIDTH:
            rows[-1:] = [together]
        else:
            rows.append(item)
    inner = ",\n".join(" " * (indent + 1) + row for row in rows)
    return f"{opening}\n{inner}\n{' ' * indent}{closing}"


def finite(value: Any) -> Any:
    """A JSON value with null in place of what is NaN or infinite."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not isfinite(value) else value


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
    try:
        commit = subprocess.run(describe, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):  # no git here, or no repository
        return found
    return found | {"commit": commit.stdout.strip()}
