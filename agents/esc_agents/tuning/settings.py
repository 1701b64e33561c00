"""What a search is: its settings, and the training run of each trial."""

from __future__ import annotations

from typing import Any

from pydantic import Field, NonNegativeInt, PositiveInt

from esc_agents.compare.grid import OWN, TUNING_EPISODES, TUNING_SEED, changed
from esc_agents.config import (
    Algorithm,
    Model,
    Seed,
    TrainConfig,
    config_for_env,
    with_algorithm,
)
from esc_agents.errors import UserError
from esc_agents.yaml_text import Mapping

EVALUATIONS = 10  # of each run, at equal distances
Parameters = dict[str, Any]


class TuneConfig(Model):
    """One search: trials of one run each, then the best of them with more seeds."""

    env: str = "highway-dense"
    """Scenario or highway-env id."""
    repr: str = "esc"
    """Representation: esc, esc-exp, fp, ap, mean, max, attention, or module:Class."""
    algo: Algorithm = "ppo"
    """sac drives with throttle and steering; ppo as the scenario says."""
    space: Mapping = Field(default_factory=dict)
    """{key of a training run: {low: 1, high: 8, log: true} or {choices: [1, 8]}}."""
    trials: PositiveInt = 24
    """Runs of the search; the first has the scenario's own settings."""
    steps: PositiveInt | None = None
    """Training steps of each; default: a third of the scenario's."""
    round: PositiveInt = 8
    """Trials that are chosen together, of what is known by then, and may run side by side."""
    prune: bool = True
    """End a run that is worse than the median of those before it had been at the same step."""
    finalists: NonNegativeInt = 3
    """Best trials that are trained again, beside the scenario's own settings, in full."""
    seeds: PositiveInt = 3
    """Runs of each finalist."""
    seed: Seed = 0
    """Of the search itself."""
    train: Mapping = Field(default_factory=dict)
    """Further fields of every training run, as in its YAML."""

    def fixed(self) -> dict[str, Any]:
        """What all that is kept in one output directory shares."""
        more = {"trials", "finalists", "seeds"}
        return self.model_dump(mode="json", exclude=more)


def scenario(config: TuneConfig) -> TrainConfig:
    """The scenario's own settings."""
    searched = {key.partition(".")[0] for key in config.space}
    if own := sorted(OWN & searched | (OWN - {"steps"}) & config.train.keys()):
        raise UserError(f"{', '.join(own)}: set by the search itself; leave it out")
    fields = {"device": "cpu", "repr": config.repr, **config.train}
    return changed(with_algorithm(config_for_env(config.env), config.algo), fields)


def train_config(
    config: TuneConfig, parameters: Parameters, seed: int, full: bool = False
) -> TrainConfig:
    """The training run of a trial. full: with as many steps as the scenario has."""
    base = scenario(config)
    steps = base.steps if full else config.steps or max(EVALUATIONS, base.steps // 3)
    nested: dict[str, Any] = {}
    for key, value in parameters.items():
        *path, last = key.split(".")
        place = nested
        for part in path:
            place = place.setdefault(part, {})
        place[last] = value
    evaluation = {"seed": TUNING_EPISODES, "every": max(1, steps // EVALUATIONS)}
    own = {"steps": steps, "seed": seed if full else TUNING_SEED + seed, "evaluation": evaluation}
    return changed(changed(base, nested), own)
