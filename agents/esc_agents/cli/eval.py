"""esc-eval: drive a trained run's policy, or an expert, on fixed seeds."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from pydantic import BaseModel, ConfigDict, PositiveInt

from esc_agents import pretrained
from esc_agents.cli import Trust, guarded, parse
from esc_agents.config import Episodes, Seed
from esc_agents.driving.planner_config import PlannerConfig
from esc_agents.errors import UserError
from esc_agents.yaml_text import Mapping

PROGRAM = "esc-eval"


class EvaluateArguments(BaseModel):
    """Drive a policy on fixed seeds and say how it went: esc-eval RUN_DIR,
    esc-eval --pretrained NAME, or esc-eval --expert planner --env NAME."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    run_dir: Annotated[Path | None, tyro.conf.Positional] = None
    """Directory that esc-train wrote."""
    pretrained: str | None = None
    """In place of a directory: an agent that comes with esc-gym."""
    expert: Literal["planner", "idm"] | None = None
    """In place of a policy that was trained: a planner that looks ahead in copies of the scene, or
    highway-env's own driver; in the scenario or id of --env."""
    planner: PlannerConfig = PlannerConfig()
    """Of --expert planner."""
    episodes: Episodes = 20
    seed: Seed = 2_000_000
    """Seed of the first episode; the others follow."""
    env: str | None = None
    """Drive in this scenario or id instead of the run's; it has to have the same observation but
    for N, and the same actions."""
    env_config: Mapping = {}
    """Drive in other traffic, e.g. {vehicles_count: 80}: merged into the env_config of the run, or
    of --env."""
    shuffle: bool = False
    """Permute the vehicles of every observation."""
    video: Path | None = None
    """Folder for a GIF of each of the first episodes, a minute of it at most."""
    videos: PositiveInt = 3
    """How many episodes to film with --video."""
    json_file: Annotated[Path | None, tyro.conf.arg(name="json")] = None
    """File for the results and every episode."""
    device: str = "auto"
    trust: Trust = False


def main() -> None:
    """Entry point of the console script."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: done."""
    arguments = parse(PROGRAM, EvaluateArguments, args)
    given = dict(arguments)
    name, expert, planner = (given.pop(key) for key in ("pretrained", "expert", "planner"))
    drivers = 3 - [name, expert, given["run_dir"]].count(None)
    if drivers != 1:
        known = ", ".join(pretrained.names()) or "none yet"
        raise UserError(
            f"expected a run directory, or --pretrained NAME (there are: {known}), or --expert "
            f"NAME, got {drivers or 'none'} of them"
        )
    if expert:
        return _expert(expert, planner, given)
    if planner != PlannerConfig():
        raise UserError("--planner: expected --expert planner beside it")
    if name:
        given["run_dir"] = pretrained.directory(name)
    from esc_agents.training.evaluation import evaluate_run

    evaluate_run(**given)
    return 0


def _expert(expert: Any, planner: PlannerConfig, given: dict[str, Any]) -> int:
    if given["env"] is None:
        raise UserError(f"--expert {expert}: expected --env, in which to drive")
    if expert == "idm" and planner != PlannerConfig():
        raise UserError("--planner: expected --expert planner beside it, got --expert idm")
    if given["shuffle"]:
        raise UserError(f"--shuffle: expected a trained policy; {expert} does not look at a set")
    from esc_agents.training.evaluation import evaluate_expert

    for key in ("run_dir", "shuffle", "device"):
        del given[key]
    evaluate_expert(planner if expert == "planner" else None, **given)
    return 0


if __name__ == "__main__":
    main()
