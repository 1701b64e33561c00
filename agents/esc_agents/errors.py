"""What the user is told: lines on the way, and the one error that means: you can mend this."""

from __future__ import annotations

import re


class UserError(Exception):
    """One line for the user: what was expected, what came, what to do. Exit code 2."""


def reason(error: BaseException) -> str:
    """What an exception says, in one line; its type too unless it is meant for the user."""
    text = " ".join(str(error).split())
    return text if isinstance(error, UserError) else f"{type(error).__name__}: {text}"


def wording(message: str) -> str:
    """A message of pydantic's in the words of people who write YAML: "x should be a mapping"."""
    message = re.sub(r"a valid dictionary(?: or instance of \w+)?", "a mapping", message)
    return re.sub(r":? Input should", " should", message).replace("Value error, ", "")


def say(text: str) -> None:
    """To people, at once."""
    print(text, flush=True)
