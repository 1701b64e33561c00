"""esc-imitate: learn to drive from what an expert says that actions are worth."""

from __future__ import annotations

import sys
from pathlib import Path

from esc_agents.cli import Trust, early, guarded, parse
from esc_agents.config import config_for_env
from esc_agents.errors import UserError
from esc_agents.imitation.settings import ImitateConfig

PROGRAM = "esc-imitate"


class ImitateArguments(ImitateConfig):
    """Learn from an expert's labels: esc-imitate --env NAME --expert planner, or --data DIR.

    Goes on with PPO: esc-train --env NAME --start-from RUN_DIR. Defaults of the observation and the
    encoder are those of the scenario.
    """

    resume: Path | None = None
    """Run directory to continue; beside it only --trust is taken."""
    trust: Trust = False


def main() -> None:
    """Entry point of the console script."""
    guarded(PROGRAM, lambda: command(sys.argv[1:]))


def command(args: list[str]) -> int:
    """0: done; 130: interrupted, saved."""
    base = _base(args)
    arguments = parse(PROGRAM, ImitateArguments, args, default=base)
    if arguments.resume:
        before, after = base.model_dump(), arguments.model_dump()
        changed = [key for key in before if before[key] != after[key]]
        if left := set(changed) - {"resume", "trust"}:
            raise UserError(
                "--resume continues a run as it was: expected only --trust beside it, got "
                f"{', '.join(sorted(left))}"
            )
    from esc_agents.imitation.imitate import imitate

    config = ImitateConfig(
        **{name: getattr(arguments, name) for name in ImitateConfig.model_fields}
    )
    return 0 if imitate(config, arguments.resume, arguments.trust) else 130


def _base(args: list[str]) -> ImitateArguments:
    """The defaults behind the flags: of the run to resume, or of --env."""
    given = early(args, "--env", "--resume")
    if given.resume is not None:
        from esc_agents.imitation.imitate import open_imitation

        base = open_imitation(Path(given.resume), given.trust)
        return ImitateArguments.model_construct(**dict(base))
    scenario = config_for_env(ImitateConfig().env if given.env is None else given.env)
    own = {"observation": scenario.observation, "encoder": scenario.encoder}
    return ImitateArguments(**own)


if __name__ == "__main__":
    main()
