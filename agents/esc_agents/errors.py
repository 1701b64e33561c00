"""What the user is told: lines on the way, and the one error that means: you can mend this."""

from __future__ import annotations

import re
from collections.abc import Iterable
from difflib import get_close_matches

from pydantic import BaseModel, ValidationError


class UserError(Exception):
    """One line for the user: what was expected, what came, what to do. Exit code 2."""


def reason(error: BaseException) -> str:
    """What an exception says, in one line; its type too unless it is meant for the user."""
    text = " ".join(str(error).split())
    return text if isinstance(error, UserError) else f"{type(error).__name__}: {text}"


def wording(message: str) -> str:
    """A message of pydantic's in the words of people who write YAML: "x should be a mapping"."""
    message = re.sub(r"a valid dictionary(?: or instance of \w+)?", "a mapping", message)
    message = re.sub(r":? Input should", " should", message).replace("Value error, ", "")
    return message.removeprefix(": ")  # of the whole, no key of it


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """The first problem of a validation on one line: key, what was expected, what came."""
    first = error.errors()[0]
    keys = [str(part) for part in first["loc"]]
    if first["type"] == "extra_forbidden":
        for key in keys[:-1]:
            model = _submodel(model, key)
        return f"unknown key {'.'.join(keys)!r}{nearest(keys[-1], model.model_fields)}"
    return wording(f"{'.'.join(keys)}: {first['msg']}, got {first['input']!r}")


def _submodel(model: type[BaseModel], key: str) -> type[BaseModel]:
    annotation = model.model_fields[key].annotation
    for candidate in (annotation, *getattr(annotation, "__args__", ())):
        if isinstance(candidate, type) and issubclass(candidate, BaseModel):
            return candidate
    return model


def nearest(name: str, known: Iterable[str]) -> str:
    """What was meant by an unknown name: the nearest that is known, or else all of them."""
    known = list(known)
    near = get_close_matches(name, known, n=1)
    return f"; did you mean {near[0]!r}?" if near else f"; expected one of {', '.join(known)}"


def say(text: str) -> None:
    """To people, at once."""
    print(text, flush=True)
