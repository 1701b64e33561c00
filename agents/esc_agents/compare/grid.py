"""What a comparison is: its settings, its runs, and the training configuration of each."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import product
from typing import Annotated, Any, Literal

import tyro
from pydantic import (
    Field,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    field_validator,
)

from esc_agents.config import (
    Algorithm,
    Episodes,
    Model,
    TrainConfig,
    config_for_env,
    with_algorithm,
)
from esc_agents.driving.environments import with_env_config
from esc_agents.errors import UserError, explain
from esc_agents.imitation.settings import ImitateConfig
from esc_agents.yaml_text import Mapping
from esc_gym.encoders import APEncoder, representation
from esc_gym.registration import NAMESPACE, merge

TUNING_SEED = 1000  # of the first tuning run: a study has fewer seeds
TUNING_EPISODES = 3_000_000  # seed of the first episode on which tuning runs are judged
EPISODES = 2_000_000  # seed of the first episode on which final policies are judged

IMITATION = "imitation"
LEARNED_FROM = ("observation", "encoder", "env_config")
"""Fields of a training run that imitation has, too."""
OWN = {"env", "repr", "algo", "steps", "seed", "run_dir"}
"""Fields of a training run that the comparison fills in."""

Many = tyro.conf.arg(metavar="VALUE [VALUE ...]")


class TuningConfig(Model):
    """The budget that every representation gets before the study, on seeds that it does not use.

    Each pair of a learning rate and a scale is tried; the highest mean return is taken.
    """

    seeds: NonNegativeInt = 1
    """Runs of each candidate; 0: nothing is tuned, the scenario's settings are taken."""
    steps: PositiveInt | None = None
    """Training steps of each; default: a third of the study's."""
    learning_rates: Annotated[tuple[PositiveFloat, ...], Many] = (1.0, 2.0)
    """Multiples of the scenario's learning rate."""
    scales: Annotated[tuple[PositiveFloat, ...], Many] = (1.0, 0.1)
    """Factors on the set code."""


class CompareConfig(Model):
    """One comparison."""

    env: Annotated[tuple[str, ...], Many, Field(min_length=1)] = (
        "highway-dense", "intersection-dense", "merge-dense",
    )  # fmt: skip
    """Scenarios or highway-env ids."""
    repr: Annotated[tuple[str, ...], Many, Field(min_length=1)] = ("esc", "fp", "ap", "attention")
    """Representations: esc, esc-exp, fp, ap, mean, max, attention, or module:Class."""
    algo: Algorithm = "ppo"
    """sac drives with throttle and steering; ppo as the scenario says."""
    learn: Literal["rl", "imitate"] = "rl"
    """imitate: from the labels of an expert, as esc-imitate does, and not by `algo`; without
    `steps`."""
    imitate: Mapping = Field(default_factory=dict)
    """Of --learn imitate: fields of every run, as flags of esc-imitate; the expert is planner, or
    labels are those of `data`. {env}, {repr} and {seed} stand for a run's own, as in `data`,
    `start_from` and `planner.policy`."""
    seeds: Annotated[int, Field(ge=1, lt=TUNING_SEED)] = 5
    """Runs of each representation in each scenario, with seeds 0, 1, 2, ..."""
    steps: PositiveInt | None = 200_000
    """Training steps of each run; None: as many as the scenario says."""
    slots: PositiveInt | None = None
    """Z: fp takes the Z nearest vehicles, ap any Z; default: N, which is all of them."""
    episodes: Episodes = 50
    """Episodes that each final policy drives, the same for all."""
    tuning: TuningConfig = TuningConfig()
    transfer: Mapping = Field(default_factory=dict)
    """{scenario: {name: env_config}}: other traffic to train and to drive in, such as
    {highway-dense: {denser: {vehicles_count: 60}}}."""
    transfer_seeds: NonNegativeInt = 1
    """Runs of each representation trained in each such traffic."""
    train: Mapping = Field(default_factory=dict)
    """Further fields of every training run, as in its YAML; in `start_from`, {env}, {repr} and
    {seed} stand for the run's own."""

    @field_validator("env", "repr")
    @classmethod
    def _once(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name.removeprefix(f"{NAMESPACE}/") for name in names))

    @property
    def way(self) -> str:
        """How is learned: the algorithm, or imitation."""
        return IMITATION if self.learn == "imitate" else self.algo

    def fixed(self) -> dict[str, Any]:
        """What all runs in one output directory share for one scenario and way of learning."""
        grid = {"env", "repr", "algo", "seeds", "transfer", "transfer_seeds", "learn"}
        if self.learn == "rl":
            return self.model_dump(mode="json", exclude=grid | {"imitate"})
        return self.model_dump(mode="json", exclude=grid) | {"steps": None}


@dataclass(frozen=True, order=True)
class Candidate:
    """What is tuned. learning_rate: a multiple of the scenario's; scale: of the set code."""

    learning_rate: float = 1.0
    scale: float = 1.0

    def __str__(self) -> str:
        return f"learning rate x {self.learning_rate:g}, code x {self.scale:g}"


@dataclass(frozen=True)
class Cell:
    """One training run. traffic: a name in ``transfer``, "" for the scenario as it is.

    algo: of ``CompareConfig.way``. tuning: whether it tries a candidate, which its name then holds.
    """

    env: str
    algo: str
    repr: str
    seed: int
    traffic: str = ""
    candidate: Candidate = Candidate()
    tuning: bool = False

    @property
    def task(self) -> str:
        return task_name(self.env, self.algo)

    @property
    def name(self) -> str:
        """<representation>[-<traffic>][-lr<a>-x<b>]-s<seed>"""
        parts = [self.repr.replace(":", "."), *([self.traffic] if self.traffic else [])]
        if self.tuning:
            parts.append(f"lr{self.candidate.learning_rate:g}-x{self.candidate.scale:g}")
        return "-".join([*parts, f"s{self.seed}"])


def task_name(env: str, algo: str) -> str:
    """The folder of all runs in a scenario with an algorithm, or by imitation."""
    return f"{env}-{algo}"


def candidates(tuning: TuningConfig) -> list[Candidate]:
    """All pairs; the scenario's own settings alone where nothing is tuned."""
    if not tuning.seeds:
        return [Candidate()]
    return [Candidate(*pair) for pair in product(tuning.learning_rates, tuning.scales)]


def tuning_cells(config: CompareConfig) -> list[Cell]:
    """The runs that choose a candidate for each representation in each scenario."""
    tried = candidates(config.tuning)
    if len(tried) == 1:
        return []
    seeds = range(TUNING_SEED, TUNING_SEED + config.tuning.seeds)
    return [
        Cell(env, config.way, repr, seed, candidate=candidate, tuning=True)
        for env, candidate, seed, repr in product(config.env, tried, seeds, config.repr)
    ]


def study_cells(config: CompareConfig) -> list[Cell]:
    """The runs that are compared, one seed of everything after the other; then other traffic."""
    cells = [
        Cell(env, config.way, repr, seed)
        for seed, env, repr in product(range(config.seeds), config.env, config.repr)
    ]
    return cells + [
        Cell(env, config.way, repr, seed, traffic)
        for seed, env in product(range(config.transfer_seeds), config.env)
        for traffic, repr in product(config.transfer.get(env, {}), config.repr)
    ]


def train_config(config: CompareConfig, cell: Cell, slots: int) -> TrainConfig:
    """The training configuration of a run. slots: Z of fp and ap."""
    base = scenario(config, cell.env, cell.traffic)
    steps = config.steps or base.steps
    if cell.tuning:
        steps = config.tuning.steps or max(1, steps // 3)
    seed = TUNING_EPISODES if cell.tuning else base.evaluation.seed
    arguments: dict[str, Any] = {**base.encoder.arguments}
    if cell.candidate.scale != 1.0:
        arguments["scale"] = cell.candidate.scale * arguments.get("scale", 1.0)
    if issubclass(representation(cell.repr), APEncoder):
        arguments.setdefault("slots", slots)
    rate = base.hyperparameters.learning_rate * cell.candidate.learning_rate
    changes = {
        "start_from": _filled(base.start_from, cell),
        "repr": cell.repr,
        "algo": config.algo,
        "seed": cell.seed,
        "steps": steps,
        "checkpoint_every": base.checkpoint_every,
        "encoder": {"arguments": arguments},
        config.algo: {"learning_rate": rate},
        "evaluation": {"seed": seed, "every": max(1, steps // 10)},
    }
    return changed(base, changes)


def imitate_config(config: CompareConfig, cell: Cell, slots: int) -> ImitateConfig:
    """A run of --learn imitate. slots: as above. Raises UserError for fields that it has not."""
    if unknown := sorted(config.train.keys() - LEARNED_FROM):
        raise UserError(
            f"train: with --learn imitate expected nothing but {', '.join(LEARNED_FROM)}, got "
            f"{', '.join(unknown)}; all else stands in --imitate"
        )
    if config.algo != "ppo":
        raise UserError(
            f"--learn imitate: expected --algo ppo, whose policy it is, got {config.algo}"
        )
    run = train_config(config, cell, slots)
    own = {name: getattr(run, name).model_dump() for name in ("observation", "encoder")}
    own |= {"env": cell.env, "repr": cell.repr, "seed": cell.seed, "device": run.device}
    own["env_config"] = run.env_config
    if taken := sorted(own.keys() & config.imitate.keys()):
        raise UserError(f"imitate: {', '.join(taken)}: set by the comparison itself; leave it out")
    given = _filled(config.imitate, cell)
    if "data" not in given:
        given = {"expert": "planner", **given}
    try:
        given = ImitateConfig.model_validate({**given, **own})
    except ValidationError as error:
        raise UserError(f"imitate: {explain(error, ImitateConfig)}") from error
    rate = given.learning_rate * cell.candidate.learning_rate
    return given.model_copy(update={"learning_rate": rate})


def _filled(value: Any, cell: Cell) -> Any:
    """``value``, in whose strings {env}, {repr} and {seed} stand for those of ``cell``.

    Raises UserError for anything else in braces.
    """
    if isinstance(value, dict):
        return {name: _filled(one, cell) for name, one in value.items()}
    if isinstance(value, str):
        for name in ("env", "repr", "seed"):
            value = value.replace(f"{{{name}}}", str(getattr(cell, name)))
        if other := re.search(r"\{.*?\}", value):
            raise UserError(f"{value}: expected {{env}}, {{repr}} or {{seed}}, got {other[0]}")
    return value


def run_config(config: CompareConfig, cell: Cell, slots: int) -> TrainConfig:
    """What a run's config.yaml says. slots: as above."""
    if config.learn == "imitate":
        return imitate_config(config, cell, slots).train_config()
    return train_config(config, cell, slots)


def sources(config: CompareConfig, cell: Cell, slots: int) -> list[str]:
    """The runs that a run goes on from, or whose policies its planner tries. slots: as above."""
    if config.learn == "imitate":
        run = imitate_config(config, cell, slots)
        found = [run.start_from, run.planner.policy]
    else:
        found = [train_config(config, cell, slots).start_from]
    return [source for source in found if source]


def scenario(config: CompareConfig, env: str, traffic: str = "") -> TrainConfig:
    """A scenario with the comparison's algorithm and ``train``, in its own or other traffic."""
    if own := sorted(OWN & config.train.keys()):
        raise UserError(f"train: {', '.join(own)}: set by the comparison itself; leave it out")
    base = changed(
        with_algorithm(config_for_env(env), config.algo), {"device": "cpu", **config.train}
    )
    if traffic:
        base = with_env_config(base, config.transfer[env][traffic])
    return base


def changed(base: TrainConfig, changes: dict[str, Any]) -> TrainConfig:
    """``base`` with fields of a training run changed. Raises UserError where they are none."""
    if isinstance(given := changes.get("env_config"), dict):
        base = with_env_config(base, given)
    try:
        return TrainConfig.model_validate(merge(base.model_dump(), changes))
    except ValidationError as error:
        raise UserError(f"train: {explain(error, TrainConfig)}") from error


def check_transfer(config: CompareConfig) -> None:
    """Raises UserError where ``transfer`` is not {scenario of the grid: {name: env_config}}."""
    for env, traffics in config.transfer.items():
        if env not in config.env:
            raise UserError(f"transfer: expected scenarios of the grid, got {env!r}")
        if not isinstance(traffics, dict) or not traffics:
            raise UserError(f"transfer {env}: expected {{name: env_config}}, got {traffics!r}")
        for name, changes in traffics.items():
            if not str(name).replace("-", "").isalnum():
                raise UserError(
                    f"transfer {env}: expected a name of letters and digits, got {name!r}"
                )
            if taken := {f"{repr}-{name}" for repr in config.repr} & {*config.repr}:
                raise UserError(
                    f"transfer {env}: expected a name that makes no other representation of one, "
                    f"got {name!r}: {min(taken)}"
                )
            if not isinstance(changes, dict):
                raise UserError(f"transfer {env}: {name}: expected an env_config, got {changes!r}")
