"""esc-paper: the experiment of the paper, and its table beside ours."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from pydantic import BaseModel, ConfigDict, Field, PositiveInt, field_validator

from esc_agents.cli import Trust, guarded, parse
from esc_agents.errors import UserError

PROGRAM = "esc-paper"
MAX_VEHICLES = 20  # as in paper.targets, which imports torch
QUICK: dict[str, Any] = {"benchmarks": (1, 3), "cases": ("5",), "seeds": 1, "updates": 1000}

Many = tyro.conf.arg(metavar="VALUE [VALUE ...]")


class _Arguments(BaseModel):
    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    trust: Trust = False


class RunArguments(_Arguments):
    """Train the cells of the paper's table. Finished cells are kept: start again to go on."""

    study: Literal["table", "code-dim", "truncation", "overtaking"] = "table"
    """The paper's table, or an ESC whose d3 is below, at and above the rule of Theorem 1, or an FP
    that takes fewer vehicles than there are, or two vehicles that change places in FP's order."""
    benchmarks: Annotated[tuple[Annotated[int, Field(ge=1, le=6)], ...], Many] = (1, 2, 3, 4, 5, 6)
    """Target policies, 1 to 6."""
    cases: Annotated[tuple[str, ...], Many] = ("5", "10", "15", "20", "any")
    """Vehicles in every set, 1 to 20, or any: uniform in 1..20."""
    repr: Annotated[tuple[str, ...], Many] = ("esc", "fp", "ap")
    """Representations; fp and ap have no case any."""
    init: Literal["glorot", "torch"] = "glorot"
    """How weights start, which the paper does not say: in Glorot's bounds and biases 0, as in its
    first author's code; or as torch starts linear layers."""
    seeds: PositiveInt = 5
    """Trainings of each cell, with seeds 0, 1, 2, ..."""
    updates: PositiveInt = 3000
    """Mini-batches of 512 in each training."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train."""
    workers: PositiveInt = os.cpu_count() or 1
    """Cells that are trained at the same time, each on one core."""
    out: Path = Path("runs/paper")
    """Directory of the results."""
    quick: bool = False
    """A small table, in minutes: benchmarks 1 and 3, five vehicles, 1000 updates, one seed."""

    @field_validator("cases")
    @classmethod
    def _known_cases(cls, cases: tuple[str, ...]) -> tuple[str, ...]:
        for case in cases:
            if case != "any" and not (case.isdecimal() and 1 <= int(case) <= MAX_VEHICLES):
                raise ValueError(f"expected 1 to {MAX_VEHICLES} vehicles, or any; got {case!r}")
        return cases

    @field_validator("benchmarks", "cases", "repr")
    @classmethod
    def _some(cls, values: tuple[Any, ...]) -> tuple[Any, ...]:
        if not values:
            raise ValueError("expected at least one value, got none")
        return tuple(dict.fromkeys(values))


class ReportArguments(_Arguments):
    """Write what finished cells show beside the paper's: report.html, .md, table.csv, pictures."""

    out: Path = Path("runs/paper")
    """Directory of the results."""


VERBS: dict[str, type[_Arguments]] = {"run": RunArguments, "report": ReportArguments}


def main() -> None:
    """Entry point of the console script."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: done."""
    verb = args[0] if args else ""
    if verb in ("-h", "--help"):
        print(f"usage: {PROGRAM} run|report [--help]\n\n{_summary()}")
        return 0
    if verb not in VERBS:
        raise UserError(f"expected {' or '.join(VERBS)}, got {verb!r}; see {PROGRAM} --help")
    arguments: Any = parse(f"{PROGRAM} {verb}", VERBS[verb], args[1:])
    return _run(arguments) if verb == "run" else _report(arguments)


def _summary() -> str:
    return "\n".join(f"  {verb:8}{type_.__doc__}" for verb, type_ in VERBS.items())


def _run(arguments: RunArguments) -> int:
    import torch

    from esc_agents.paper.experiment import grid, run, study
    from esc_gym.encoders import representation

    if arguments.device == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda: torch finds no GPU here; leave it out, or give cpu")
    defaults = RunArguments()
    if arguments.quick and any(getattr(arguments, n) != getattr(defaults, n) for n in QUICK):
        raise UserError(
            f"--quick sets {', '.join('--' + name for name in QUICK)}; give one or other"
        )
    fixed = ("cases", "repr", "quick")
    if arguments.study != "table" and any(
        getattr(arguments, n) != getattr(defaults, n) for n in fixed
    ):
        raise UserError(
            f"--study {arguments.study} sets {', '.join('--' + name for name in fixed)}; "
            "leave them out"
        )
    chosen = dict(arguments) | (QUICK if arguments.quick else {})
    for name in chosen["repr"]:
        try:
            representation(name)
        except ValueError as error:
            raise UserError(f"--repr: {error}") from error
    sizes = [None if case == "any" else int(case) for case in chosen["cases"]]
    seeds = range(chosen["seeds"])
    if arguments.study == "table":
        cells = grid(chosen["benchmarks"], sizes, chosen["repr"], seeds)
    else:
        cells = study(arguments.study, chosen["benchmarks"], seeds)
    cells = [replace(cell, init=chosen["init"]) for cell in cells]
    folder = chosen["out"] / "cells"
    run(cells, chosen["updates"], chosen["device"], chosen["workers"], folder, arguments.trust)
    return 0


def _report(arguments: ReportArguments) -> int:
    from esc_agents.paper.report import report

    report(arguments.out, arguments.trust)
    return 0


if __name__ == "__main__":
    main()
