"""Files of others run no code: who wrote a file, and what it names that would be imported.

What a user writes, this user's key signs. The signature stands in the file itself, so that nothing
can separate the two. Where it is missing or wrong, a name outside esc_gym and highway_env is
refused before anything is imported, unless the user trusts whoever wrote the file.
"""

from __future__ import annotations

import hmac
import os
import re
import secrets
from contextlib import suppress
from pathlib import Path
from typing import Any

from platformdirs import user_state_path

from esc_agents.errors import UserError

BLANK = "0" * 64
"""What a text says as its ``mac`` until it is signed."""
KEYS = {"env", "repr", "representation", "other_vehicles_type"}
"""Keys, at any depth, or parts of dotted ones, under which esc_gym, highway-env and Gymnasium take
a name to import."""
_MAC = re.compile(rb"\bmac\W{1,4}([0-9a-f]{64})")
_OURS = re.compile(r"(esc_gym|highway_env)(\.[a-z_]\w*)*[.:]\w+", re.ASCII)


def sign(data: bytes) -> bytes:
    """What only this user can make of ``data`` [32]. Raises UserError where no key can be kept."""
    return hmac.digest(_key(), data, "sha256")


def signed(text: str) -> str:
    """``text`` with its BLANK, after ``mac: `` or the like, filled in.

    Where this user can keep no key it stays, and the text counts as a stranger's.
    """
    with suppress(UserError):
        return text.replace(BLANK, _mac(text.encode()), 1)
    return text


def check(path: Path, data: bytes, values: Any, trust: bool) -> None:
    """Raises UserError where a file that this user did not write names code that is not ours.

    data: its bytes. values: what they say. trust: whether the user trusts whoever wrote it.
    """
    if (names := foreign(values)) and not trust and not _ours(data):
        raise UserError(
            f"{path} names {names[0]!r}, and to load that can run code of whoever wrote the file, "
            "which was not you on this machine; add --trust if you trust them"
        )


def foreign(values: Any) -> list[str]:
    """The names under KEYS that would be imported from elsewhere than esc_gym and highway_env."""
    found: list[str] = []
    todo: list[tuple[bool, Any]] = [(False, values)]
    seen = set()  # YAML can hold a mapping in itself
    while todo:
        named, value = todo.pop()
        if isinstance(value, dict | list | tuple | set) and (named, id(value)) not in seen:
            seen.add((named, id(value)))
            items = value.items() if isinstance(value, dict) else ((None, item) for item in value)
            todo += [(named or bool(KEYS & {*_text(key).split(".")}), item) for key, item in items]
        elif named and {".", ":"} & set(name := _text(value)) and not _OURS.fullmatch(name):
            found.append(name)
    return found


def _text(value: Any) -> str:
    """YAML's bytes as the text that pydantic makes of them; "" for what is neither."""
    text = value.decode(errors="replace") if isinstance(value, bytes) else value
    return text if isinstance(text, str) else ""


def _ours(data: bytes) -> bool:
    found = _MAC.search(data)
    if not found:
        return False
    blank = data[: found.start(1)] + BLANK.encode() + data[found.end(1) :]
    with suppress(UserError):
        return hmac.compare_digest(found[1], _mac(blank).encode())
    return False


def _mac(text: bytes) -> str:
    return sign(b"text\n" + text).hex()  # never what a checkpoint's pickle signs


def _key() -> bytes:
    """This user's secret, made on first use."""
    path = user_state_path("esc_gym") / "checkpoint.key"
    new = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(os.open(new, os.O_WRONLY | os.O_CREAT, 0o600), "wb") as file:
                file.write(secrets.token_bytes(32))
            with suppress(FileExistsError):  # another process was first: then its key counts
                os.link(new, path)
            new.unlink()
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"checkpoints need {path}: {error.strerror}") from error
