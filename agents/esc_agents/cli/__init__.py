"""Console scripts: one thin file each. User errors: one line on stderr, exit code 2."""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn, TypeVar

import tyro

from esc_agents.errors import UserError

T = TypeVar("T")


def exit_with(program: str, message: str) -> NoReturn:
    """One line on stderr, exit code 2."""
    print(f"{program}: {' '.join(message.split())}", file=sys.stderr)
    raise SystemExit(2)


def guarded(program: str, command: Callable[[], int]) -> NoReturn:
    """Run a command; a UserError ends it with its one line."""
    try:
        code = command()
    except UserError as error:
        exit_with(program, str(error))
    except KeyboardInterrupt:
        code = 130
    raise SystemExit(code)


def parse(program: str, type_: type[T], args: Sequence[str], default: Any = None) -> T:
    """tyro.cli, with its framed errors cut down to one line."""
    extra = {} if default is None else {"default": default}
    errors = io.StringIO()
    columns = os.environ.get("COLUMNS")
    try:
        with contextlib.redirect_stderr(errors):
            if not {"-h", "--help"} & set(args):
                os.environ["COLUMNS"] = "10000"  # no line breaks inside a message
            return tyro.cli(type_, prog=program, args=list(args), **extra)
    except SystemExit as end:
        if end.code in (0, None):
            raise
        exit_with(program, _one_line(errors.getvalue()))
    finally:
        os.environ.pop("COLUMNS", None)
        if columns is not None:
            os.environ["COLUMNS"] = columns


def _one_line(framed: str) -> str:
    lines = [line.strip("│╭╮╰╯ ") for line in framed.splitlines()]
    body = [line for line in lines[1:] if line]
    end = next((i for i, line in enumerate(body) if set(line) <= {"─"}), len(body))
    text = " ".join(body[:end])
    text = re.sub(r"\[type=\w+, input_value=(.*?), input_type=\w+\]", r"(got \1)", text)
    text = re.sub(r"For further information visit \S+", "", text)
    text = re.sub(r"Error parsing [\w.]+: \d+ validation errors? for \w+ ", "", text)
    return text
