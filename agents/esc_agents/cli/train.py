"""esc-train: train an agent in one of highway-env's scenarios."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, get_args

from esc_agents.cli import Trust, early, guarded, parse
from esc_agents.config import (
    Algorithm,
    TrainConfig,
    config_for_env,
    load_config,
    scenarios,
    with_algorithm,
)
from esc_agents.errors import UserError
from esc_gym.registration import merge

PROGRAM = "esc-train"


class TrainArguments(TrainConfig):
    """Train an agent in one of highway-env's scenarios.

    Defaults are those of the scenario that --env or --config names; any field can be overridden.
    """

    config: str | None = None
    """YAML file, or name of a shipped scenario, with the values of all other flags."""
    resume: Path | None = None
    """Run directory to continue; beside it only --steps and --trust are taken."""
    trust: Trust = False


RESUMABLE = {"steps", "resume", "trust"}


def main() -> None:
    """Entry point of the console script."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: done; 130: interrupted, saved."""
    base = _base(args)
    arguments = parse(PROGRAM, TrainArguments, args, default=base)
    config = _config(arguments, base)
    if arguments.resume:
        before, after = base.model_dump(), arguments.model_dump()
        if changed := [key for key in before if before[key] != after[key] and key not in RESUMABLE]:
            raise UserError(
                f"--resume continues a run as it was: expected only --steps and --trust beside "
                f"it, got {', '.join(changed)}"
            )
    from esc_agents.training.train import train

    return 0 if train(config, resume=arguments.resume, trust=arguments.trust) else 130


def _base(args: list[str]) -> TrainArguments:
    """The defaults behind the flags: of the run to resume, of --config, or of --env."""
    given = early(args, "--config", "--env", "--resume", algo=get_args(Algorithm))
    if given.resume is not None:
        from esc_agents.training.run_directory import open_run

        base = open_run(Path(given.resume), given.trust)
        return TrainArguments.model_construct(**dict(base))
    if given.config is not None:
        base = load_config(given.config, given.trust)
    else:
        base = config_for_env(TrainConfig().env if given.env is None else given.env)
    if given.algo not in (None, base.algo):
        base = with_algorithm(base, given.algo)
    return TrainArguments.model_construct(**dict(base))


def _config(arguments: TrainArguments, base: TrainArguments) -> TrainConfig:
    """The run's configuration: ``arguments`` with scenario names resolved to ids."""
    from esc_agents.driving.environments import with_env_config

    values = dict(arguments)
    for name in ("config", "resume", "trust"):
        del values[name]
    # Flags add to what is there, and --env-config also beats what SAC and training change in it.
    there = with_env_config(base, _other(arguments.env_config, base.env_config))
    values["env_config"] = there.env_config
    if arguments.continuous and base.continuous and there.continuous:
        more = _other(arguments.continuous.env_config, base.continuous.env_config)
        task = {"env_config": merge(there.continuous.env_config, more)}
        values["continuous"] = arguments.continuous.model_copy(update=task)
    for algo in get_args(Algorithm):
        own, flags = getattr(base, algo).train_env_config, getattr(arguments, algo)
        more = _other(flags.train_env_config, own)
        task = {"train_env_config": merge(getattr(there, algo).train_env_config, more)}
        values[algo] = flags.model_copy(update=task)
    if not arguments.config:
        values["env"] = base.env  # --env may have named a scenario, of which this is the id
    elif arguments.env in scenarios() and arguments.env != base.env:
        raise UserError(
            f"--env beside --config: expected a highway-env id, got the scenario {arguments.env!r}"
        )
    return TrainConfig(**values)


def _other(flag: dict[str, Any], default: dict[str, Any]) -> dict[str, Any]:
    """What a flag says; {} where it was not given, and so is its default."""
    return flag if flag != default else {}


if __name__ == "__main__":
    main()
