"""Results as JSON files that are there whole or not at all, and are checked when they are read."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from esc_agents import files


class Damaged(Exception):
    """A result file that is not what was written; says which and why."""


def write(path: Path, schema: int, content: dict[str, Any]) -> None:
    """Write a record at once; infinities, which JSON does not have, as null."""
    # Through JSON once, which makes all keys text, as they will be read.
    plain = json.loads(json.dumps({"schema": schema, **files.finite(content)}, allow_nan=False))
    files.write_json(path, {"sha256": _digest(plain), **plain})


def read(path: Path, schema: int) -> dict[str, Any]:
    """What ``write`` was given. Raises Damaged."""
    try:
        record = json.loads(path.read_bytes())
        if record.pop("sha256") != _digest(record):
            raise Damaged(f"{path}: its contents do not match their checksum")
        if record.pop("schema") != schema:
            raise Damaged(f"{path}: written by another version of esc-gym")
    except (OSError, ValueError, AttributeError, KeyError, TypeError) as error:
        raise Damaged(f"{path}: not a whole record ({error!r})") from error
    return record


def rewrite(path: Path) -> bool:
    """Give a JSON file the form in which files are written today; no value changes.

    Returns whether it had another one. Raises Damaged where it is no JSON.
    """
    try:
        text = path.read_text(encoding="utf-8")
        value = json.loads(text)
    except (OSError, ValueError) as error:
        raise Damaged(f"{path}: not readable as JSON ({error!r})") from error
    if (new := files.json_text(value) + "\n") != text:
        files.write_text(path, new)
    return new != text


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
