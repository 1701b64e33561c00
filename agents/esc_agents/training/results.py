"""The table with which a run ends: its policy beside drivers that have learned nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from esc_agents.config import TrainConfig, scenario_name
from esc_agents.driving.baselines import blind_policies, rule_driver, verdict
from esc_agents.driving.episodes import (
    Episode,
    Policy,
    Summary,
    as_rows,
    evaluate,
    seeds,
    table,
)
from esc_agents.driving.experts import PLANNER, reference_planner
from esc_agents.driving.rule_driver import RULE
from esc_agents.errors import reason, say
from esc_agents.reporting.tables import show, terminal
from esc_agents.training import run_directory


def rule_summary(config: TrainConfig, stop: Callable[[], bool]) -> Summary | None:
    """How IDM/MOBIL drives; None, and a line that says why, where it cannot."""
    return _summary(RULE, rule_driver, config, stop)


def _summary(
    name: str, driven: Callable[..., list[Episode]], config: TrainConfig, stop: Callable[[], bool]
) -> Summary | None:
    try:
        drives = driven(config, seeds(config), stop)
    except Exception as error:  # nothing that it meets may cost the run its results
        say(f"{name} is missing: {reason(error)}")
        return None
    return Summary.of(drives) if drives else None


def results(
    config: TrainConfig, policy: Policy, judges: VecEnv, names: dict[int, str],
    rule: Summary | None, stop: Callable[[], bool],
) -> dict[str, Summary]:  # fmt: skip
    """A trained policy, the blind ones, IDM/MOBIL and the planner on the same episodes.

    judges: environments for evaluation. names: of discrete actions. stop: as of ``evaluate``.
    """
    space, seed = judges.action_space, config.evaluation.seed
    blind = blind_policies(space, judges.num_envs, names, seed)
    if not stop():
        say(f"Evaluating {config.repr} beside {len(blind)} blind policies, {RULE}, a planner ...")
    found = {}
    for name, driver in ({config.repr: policy} | blind).items():
        if stop():
            break
        if episodes := evaluate(judges, driver, seeds(config), stop):
            found[name] = Summary.of(episodes)
    planner = None if stop() else _summary(PLANNER, reference_planner, config, stop)
    references = {RULE: rule, PLANNER: planner}
    return found | {name: summary for name, summary in references.items() if summary}


def finish(config: TrainConfig, directory: Path, found: dict[str, Summary], steps: int) -> None:
    """Write ``results`` into the run's directory, with which it is finished, and print them.

    steps: of training, or labels, for the title.
    """
    run_directory.finish(directory, as_rows(found))
    what = run_directory.learned(directory, config, steps)
    title = (
        f"{scenario_name(config)}, {config.repr}, {what}; episodes: {config.evaluation.episodes}"
    )
    show(terminal(table(found), title))
    others = config.repr, RULE, PLANNER
    blind: Any = {name: s for name, s in found.items() if name not in others}
    say(verdict(config.repr, found[config.repr], blind))
    say(f"Run directory: {directory}")
