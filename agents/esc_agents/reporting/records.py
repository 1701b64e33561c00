"""Results as JSON files that are there whole or not at all, and are checked when they are read."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from esc_agents import files, strangers


class Damaged(Exception):
    """A result file that is not what was written; says which and why."""


def write(path: Path, schema: int, content: dict[str, Any]) -> None:
    """Write a record at once; infinities, which JSON does not have, as null."""
    # Through JSON once, which makes all keys text, as they will be read.
    plain = json.loads(json.dumps({"schema": schema, **files.finite(content)}, allow_nan=False))
    record = {"sha256": _digest(plain), "mac": strangers.BLANK, **plain}
    files.write_text(path, strangers.signed(files.json_text(record) + "\n"))


def read(path: Path, schema: int, trust: bool = False) -> dict[str, Any]:
    """What ``write`` was given. Raises Damaged.

    trust: whether a record that this user did not write may name code to import, else a UserError.
    """
    try:
        data = path.read_bytes()
        record = json.loads(data)
        record.pop("mac", None)
        if record.pop("sha256") != _digest(record):
            raise Damaged(f"{path}: its contents do not match their checksum")
        if record.pop("schema") != schema:
            raise Damaged(f"{path}: written by another version of esc-gym")
    except (OSError, ValueError, AttributeError, KeyError, TypeError) as error:
        raise Damaged(f"{path}: not a whole record ({error!r})") from error
    strangers.check(path, data, record, trust)
    return record


def rewrite(path: Path) -> bool:
    """Give a record of an earlier version the form of today's; no value changes.

    Returns whether it was one, in another form. Raises Damaged where it is no JSON.
    """
    try:
        text = path.read_text(encoding="utf-8")
        record = json.loads(text)
    except (OSError, ValueError) as error:
        raise Damaged(f"{path}: not readable as JSON ({error!r})") from error
    # Those of today are signed, and their signature is of every byte.
    if not isinstance(record, dict) or not {"sha256", "schema"} <= record.keys():
        return False
    if "mac" in record or (new := files.json_text(record) + "\n") == text:
        return False
    files.write_text(path, new)
    return True


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
