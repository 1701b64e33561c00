"""Console scripts: one thin file each. User errors: one line on stderr, exit code 2."""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import sys
from collections.abc import Callable, Sequence
from decimal import Decimal
from typing import Annotated, Any, NoReturn, TypeVar

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from esc_agents.errors import UserError, wording

T = TypeVar("T")
Trust = Annotated[
    bool,
    tyro.conf.arg(
        help="Also load files of somebody else that can run their code: pickled objects, and names "
        "of modules outside esc_gym and highway_env."
    ),
]

_RULES = ConstructorRegistry()


@_RULES.primitive_rule
def _whole_numbers(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[int] | None:
    """--steps 1e6 is a million, as in the YAML files."""
    if info.type is not int:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=lambda words: _whole(words[0]),
        is_instance=lambda value: type(value) is int,
        str_from_instance=lambda value: [str(value)],
    )


def _whole(word: str) -> int:
    with contextlib.suppress(ArithmeticError, ValueError):
        number = Decimal(word)  # exact, where a float would change 2**53 + 1
        if abs(number) < 2**63 and number == int(number):
            return int(number)
    raise ValueError(f"expected a whole number below 2^63, got {word!r}")


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
    except (MemoryError, RuntimeError) as error:
        if not _no_memory(error):
            raise
        exit_with(program, f"not enough memory: {error or 'for what was asked'}; ask for less")
    except BrokenPipeError:  # `esc-train --help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 141
    raise SystemExit(code)


def _no_memory(error: Exception) -> bool:
    """Whether Python, NumPy or torch, on the CPU or a GPU, found none. By names: a console script
    imports torch late."""
    return (
        isinstance(error, MemoryError)
        or type(error).__name__ == "OutOfMemoryError"
        or "DefaultCPUAllocator" in str(error)
    )


def parse(program: str, type_: type[T], args: Sequence[str], default: Any = None) -> T:
    """tyro.cli, with its framed errors cut down to one line."""
    extra = {} if default is None else {"default": default}
    errors = io.StringIO()
    columns = os.environ.get("COLUMNS")
    try:
        with contextlib.redirect_stderr(errors):
            if not {"-h", "--help"} & set(args):
                os.environ["COLUMNS"] = "10000"  # no line breaks inside a message
            return tyro.cli(
                type_, prog=program, args=list(args), config=(tyro.conf.AvoidSubcommands,),
                registry=_RULES, **extra,
            )  # fmt: skip
    except SystemExit as end:
        if end.code in (0, None):
            raise
        exit_with(program, _one_line(errors.getvalue()))
    finally:
        os.environ.pop("COLUMNS", None)
        if columns is not None:
            os.environ["COLUMNS"] = columns


def early(args: Sequence[str], *flags: str, **choices: Sequence[str]) -> argparse.Namespace:
    """What stands behind ``flags`` and --trust, on which the defaults of all others depend.

    choices: further flags, by name, and what each may say.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for flag in flags:
        parser.add_argument(flag)
    for name, allowed in choices.items():
        parser.add_argument(f"--{name}", choices=allowed)
    parser.add_argument("--trust", action=argparse.BooleanOptionalAction, default=False)
    try:
        return parser.parse_known_args(args)[0]
    except argparse.ArgumentError as error:
        raise UserError(str(error)) from error


def _one_line(framed: str) -> str:
    """The message of tyro's box, and what it guesses was meant; drawn in ASCII or not, coloured or
    not, as the terminal can."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", framed)
    lines = [line.strip("│|+╭╮╰╯ ") for line in plain.splitlines()]
    text = "\n".join("" if set(line) <= set("─-") else line for line in lines[1:])
    message, *more = [" ".join(part.split()) for part in re.split(r"\n{2,}", text.strip("\n"))]
    message = wording(message)
    message = re.sub(r" \[type=\w+, input_value=(.*?), input_type=\w+\]", r", got \1", message)
    message = re.sub(r" ?For further information visit \S+", "", message)
    message = re.sub(r"Error parsing \w+Arguments: \d+ validation errors? for \w+ ", "", message)
    message = re.sub(r"Error parsing ([\w.]+): \d+ validation errors? for \w+ ", r"\1.", message)
    message = re.sub(
        r"no type matching \{None\}\|INT could be instantiated from \['(.*?)'\]",
        r"expected a whole number below 2^63, or None, got '\1'",
        message,
    )
    message = re.sub(
        r"Could not find valid parse for arguments: \[(.*)\]",
        r"expected what --help says, got \1",
        message,
    )
    guesses = [part.split()[3] for part in more if part.startswith("Perhaps you meant: ")]
    if guesses:
        return f"{message}; did you mean {guesses[0]}?"
    return f"{message}; see --help" if message.startswith("Unrecognized") else message
