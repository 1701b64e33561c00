"""esc-tune: a search for the settings of a scenario."""

from __future__ import annotations

import sys
from pathlib import Path

from esc_agents.cli import Trust, guarded, parse
from esc_agents.cli._engines import EngineArguments, base_of, interruptible
from esc_agents.errors import UserError
from esc_agents.tuning.settings import TuneConfig

PROGRAM = "esc-tune"


class TuneArguments(EngineArguments, TuneConfig):
    """Search for settings with which a representation learns a scenario best.

    What --out holds already is kept: start again to go on, or ask for more to add to it.
    """

    config: str | None = None
    """YAML file, or name of a shipped search (ppo, sac), with the values of all other flags."""
    out: Path = Path("runs/tune")
    """Directory of the trials and the report."""
    trust: Trust = False


def main() -> None:
    """Entry point of the console script."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: done; 130: interrupted, saved."""
    base = base_of(args, "tune", TuneConfig)
    arguments = parse(
        PROGRAM, TuneArguments, args, default=TuneArguments.model_construct(**dict(base))
    )
    own = {name: getattr(arguments, name) for name in TuneConfig.model_fields}
    config = TuneConfig(**own)
    try:
        from esc_agents.tuning.tune import tune
    except ModuleNotFoundError as missing:
        if missing.name != "optuna":
            raise
        raise UserError(
            "Optuna is not installed; install it with: pip install 'esc-gym[tune]'"
        ) from missing
    engine = arguments.make()
    return interruptible(lambda: tune(config, arguments.out, engine, arguments.trust))


if __name__ == "__main__":
    main()
