"""What a run is: strict, frozen pydantic models, filled from YAML and the command line."""

from __future__ import annotations

from importlib.resources import files
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    field_validator,
)

from esc_agents import strangers, yaml_text
from esc_agents.errors import UserError, explain, nearest
from esc_agents.yaml_text import YAML_ARGUMENT, Mapping, parse
from esc_gym.features import DEFAULT_FEATURES
from esc_gym.registration import ENV_IDS, MULTI_AGENT_IDS, NAMESPACE

SCHEMA = 1  # of the YAML files
Probability = Annotated[float, Field(ge=0.0, le=1.0)]
Seed = Annotated[int, Field(ge=0, lt=2**32)]  # what NumPy takes
Size = Annotated[int, Field(gt=0, le=2**16)]  # of what lies in memory at once; more is a slip
Width = Annotated[int, Field(gt=0, le=2**13)]  # of a layer
Episodes = Annotated[int, Field(gt=0, le=10**6)]
Threads = Annotated[int, Field(gt=0, le=1024)]
Schedule = Literal["constant", "linear"]
Algorithm = Literal["ppo", "sac"]
NOUNS = {
    "train": "scenario", "compare": "comparison", "tune": "search", "imitate": "imitation",
}  # fmt: skip
"""Kinds of configurations, and what one of each is called."""


M = TypeVar("M", bound=BaseModel)
Ranges = Annotated[dict[str, tuple[float, float]], YAML_ARGUMENT]


class Model(BaseModel):
    """Base of all configurations: strict, frozen, documented."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True,
        ser_json_inf_nan="constants",  # in a mapping for highway-env they may be meant
    )  # fmt: skip


class ObservationConfig(Model):
    """Arguments of esc_gym.SetObservation."""

    max_vehicles: Size | None = None
    """N, rows of the padded set; default: as many as the scenario can hold."""
    features: tuple[str, ...] = DEFAULT_FEATURES
    """Columns of a vehicle (d1 of them)."""
    ego_features: tuple[str, ...] | None = None
    """Entries of the ego vector (d2 of them); default: the scenario's."""
    perception_distance: PositiveFloat = 200.0
    """Radius of the set [m]."""
    order: Literal["road", "shuffled", "distance"] | None = None
    """Order of the rows; default: shuffled for ap, which must see every order, else road."""
    frame: Literal["world", "ego"] | None = None
    """Axes; default: the ego's body frame where the road turns."""
    ranges: Ranges = {}
    """{feature: [low, high]} mapped to [-1, 1]; default: all that can occur."""
    empty: Literal["zeros", "virtual"] = "zeros"
    """What a set without vehicles looks like."""
    on_overflow: Literal["warn", "error"] = "warn"
    """What happens when more than max_vehicles are near."""
    goal: bool = False
    """Parking's goal in keys of its own, for sac.hindsight, instead of in `ego`."""
    accelerate: bool = True
    """Simulate with compiled code, on the same trajectories."""


ENCODER_FIELDS = {
    "representation", "hidden", "code_dim", "match_parameters",
    "observation_space", "vehicle_dim", "ego_dim", "max_vehicles",
}  # fmt: skip
"""Arguments of a SetExtractor or SetEncoder that other fields of a configuration say."""


class EncoderConfig(Model):
    """The features extractor."""

    hidden: tuple[Width, ...] = (64, 64)
    """Hidden widths of ESC's h; other representations get as many parameters as that has."""
    code_dim: Size | None = None
    """d3; default: N*d1 + 1, the paper's Theorem 1."""
    match_parameters: bool = True
    """False: every representation takes `hidden` as it is."""
    arguments: Mapping = {}
    """Further arguments of the encoder class, e.g. {scale: 0.1} or {slots: 15}."""

    @field_validator("arguments")
    @classmethod
    def _further(cls, arguments: dict[str, Any]) -> dict[str, Any]:
        if taken := sorted(arguments.keys() & ENCODER_FIELDS):
            raise ValueError(
                "expected what only the encoder class has; --repr, the observation and the other "
                f"fields of encoder say {', '.join(taken)}"
            )
        return arguments


class ContinuousConfig(Model):
    """What --algo sac changes in a scenario."""

    env_config: Mapping = {}
    """Merged over the scenario's env_config."""
    progress_reward: NonNegativeFloat = 0.0
    """Reward per policy step for 30 m/s along the lane; less, or negative, in proportion."""
    offroad_terminal: bool = False
    """End the episode where the ego leaves the road."""
    steps: PositiveInt | None = None
    """Training steps; default: the scenario's. SAC gets more out of each, and takes longer."""


class AlgorithmConfig(Model):
    """What every algorithm has."""

    train_env_config: Mapping = {}
    """highway-env configuration, merged over all other in training only: rewards that show the way,
    or other traffic. Evaluations are of the scenario itself. A flag adds to the scenario's;
    what --env-config names is in training as that says."""
    use_sde: bool = False
    """With continuous actions, explore by a noise that lasts and depends on the state (gSDE): it
    turns the wheel where independent noise would only shake it."""
    sde_sample_freq: Annotated[int, Field(ge=-1)] = -1
    """Steps for which gSDE's noise lasts; -1: a whole rollout."""


class PPOConfig(AlgorithmConfig):
    """Stable-Baselines3 PPO."""

    learning_rate: PositiveFloat = 5e-4
    learning_rate_schedule: Schedule = "constant"
    """linear: the rate falls from `learning_rate` at the first step to 0 at the last."""
    n_steps: Annotated[int, Field(ge=2)] = 64
    """Steps per environment in one rollout."""
    batch_size: Annotated[int, Field(ge=2)] = 256
    n_epochs: PositiveInt = 10
    gamma: Probability = 0.95
    gae_lambda: Probability = 0.95
    clip_range: PositiveFloat = 0.2
    ent_coef: NonNegativeFloat = 0.01
    ent_coef_schedule: Schedule = "constant"
    """linear: the coefficient falls to 0 at the last step."""
    vf_coef: NonNegativeFloat = 0.5
    max_grad_norm: PositiveFloat = 0.5
    value_warmup: NonNegativeInt = 0
    """Training steps in which the value network alone learns, at the beginning of a run with
    `start_from`: before it can judge, its errors would spoil what the policy knows."""
    crash_replay: Probability = 0.0
    """In the second half of the training, the share of the episodes that begin some steps before a
    collision of an earlier one and end some steps after its moment: a good driver meets such states
    too rarely to learn from them. 0: none. Others need the batch engine."""
    ortho_init: bool = True
    """SB3's orthogonal initialisation, of the encoder too; false: PyTorch's own."""
    net_arch: tuple[Width, ...] = (64, 64)
    """Hidden widths of the policy and of the value network after the features extractor."""


class SACConfig(AlgorithmConfig):
    """Stable-Baselines3 SAC."""

    learning_rate: PositiveFloat = 3e-4
    learning_rate_schedule: Schedule = "constant"
    """linear: the rate falls from `learning_rate` at the first step to 0 at the last."""
    buffer_size: PositiveInt = 100_000
    hindsight: bool = False
    """Learn from goals that were reached by chance, too (HER); needs `observation.goal`."""
    learning_starts: NonNegativeInt = 500
    batch_size: Annotated[int, Field(ge=2)] = 256
    gamma: Probability = 0.98
    tau: Probability = 0.005
    train_freq: PositiveInt = 1
    """Steps of each environment between two rounds of updates."""
    gradient_steps: Annotated[int, Field(ge=-1)] = 1
    """Updates in a round, whatever the number of environments; -1: one for each of their steps."""
    net_arch: tuple[Width, ...] = (128, 128)
    """Hidden widths of the actor and of the critics after the features extractor."""


class EvaluationConfig(Model):
    """Evaluation during training and at its end, on fixed seeds that training never sees."""

    every: PositiveInt | None = None
    """Training steps between two evaluations; default: a fifth of the run, at least 1000."""
    episodes: Episodes = 10
    seed: Seed = 1_000_000
    """Seed of the first episode; the others follow."""


class TrainConfig(Model):
    """One training run."""

    env: str = "highway-v0"
    """highway-env id (highway-v0), or the name of a scenario (highway-dense)."""
    repr: str = "esc"
    """Representation: esc, esc-exp, fp, ap, mean, max, attention, or module:Class."""
    algo: Algorithm = "ppo"
    """sac drives with throttle and steering (`continuous`); ppo as the scenario says."""
    steps: PositiveInt = 100_000
    """Training steps over all environments; PPO ends with a whole rollout."""
    seed: Seed = 0
    n_envs: Size = 8
    """Environments that training steps at once."""
    vec: Literal["auto", "batch", "dummy", "subproc"] = "auto"
    """batch: all environments in the batch engine; dummy: as objects, one after the other; subproc:
    in a process each; auto: what is fastest. The results are the same."""
    threads: Threads = 1
    """torch's threads on the CPU; more pay for wide networks and large batches on idle cores."""
    device: str = "auto"
    """torch device: auto, cpu, cuda, cuda:1."""
    start_from: str | None = None
    """Begin with the weights of another run, and nothing else of it: its directory, or zoo:NAME for
    an agent that comes with the package."""
    run_dir: Path | None = None
    """New directory for the run; default: runs/<scenario>-<repr>-<algo>-<seed>-<time>."""
    checkpoint_every: PositiveInt = 10_000
    """Training steps between two checkpoints, from which --resume continues exactly."""
    env_config: Mapping = {}
    """highway-env configuration, merged into the id's own."""
    continuous: ContinuousConfig | None = None
    observation: ObservationConfig = ObservationConfig()
    encoder: EncoderConfig = EncoderConfig()
    ppo: PPOConfig = PPOConfig()
    sac: SACConfig = SACConfig()
    evaluation: EvaluationConfig = EvaluationConfig()

    @property
    def hyperparameters(self) -> PPOConfig | SACConfig:
        return self.sac if self.algo == "sac" else self.ppo


def configs_folder() -> Path:
    """Where the shipped YAML lies: inside the wheel, else at the root of the repository."""
    packaged = Path(str(files("esc_agents"))) / "configs"
    return packaged if packaged.is_dir() else Path(__file__).parents[2] / "configs"


def shipped(kind: str) -> dict[str, Path]:
    """The YAML files that come with the package, by name. kind: of NOUNS."""
    return {path.stem: path for path in sorted((configs_folder() / kind).glob("*.yaml"))}


def scenarios() -> dict[str, Path]:
    """The shipped training scenarios by name."""
    return shipped("train")


def load_config(name: str | Path, trust: bool = False) -> TrainConfig:
    """A training configuration: an existing YAML file, or a shipped scenario's name."""
    return load(name, "train", TrainConfig, trust)


def load(name: str | Path, kind: str, model: type[M], trust: bool = False) -> M:
    """A configuration of a kind: an existing YAML file, or a shipped one's name.

    trust: whether a file that this user did not write may name code to import.
    """
    path = Path(name)
    if not path.is_file():
        known = shipped(kind)
        if str(name) not in known:
            what = NOUNS[kind]
            raise UserError(
                f"config: no file {str(name)!r} and no such {what}{nearest(str(name), known)}"
            )
        path, trust = known[str(name)], True
    try:
        data = path.read_bytes()
        values = parse(data.decode())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise UserError(f"config {path}: not readable as YAML: {error}") from error
    if not isinstance(values, dict):
        raise UserError(f"config {path}: expected keys and values, got {type(values).__name__}")
    if (schema := values.pop("schema", SCHEMA)) != SCHEMA:
        raise UserError(
            f"config {path}: expected schema {SCHEMA}, got {schema!r}; it is of another esc-gym"
        )
    strangers.check(path, data, values, trust)
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise UserError(f"config {path}: {explain(error, model)}") from error


def config_for_env(env: str) -> TrainConfig:
    """The defaults for ``--env``: a scenario, or an id with the scenario of its name if shipped."""
    env = env.removeprefix(f"{NAMESPACE}/")
    known = scenarios()
    if env in known:
        return load_config(known[env], trust=True)
    check_env_id(env)
    family = env.rpartition("-v")[0]
    base = load_config(known[family], trust=True) if family in known else TrainConfig()
    return base.model_copy(update={"env": env})


def with_algorithm(config: TrainConfig, algo: Algorithm) -> TrainConfig:
    """A scenario with another algorithm than its own, and as many steps as it has for that."""
    own = config.continuous.steps if algo == "sac" and config.continuous else None
    return config.model_copy(update={"algo": algo, "steps": own or config.steps})


def check_env_id(env: str) -> None:
    """Raises UserError unless ``env`` is a single-agent highway-env id."""
    if env in MULTI_AGENT_IDS:
        raise UserError(
            f"env {env!r} is multi-agent; expected one of the {len(ENV_IDS)} single-agent ids, "
            "for example intersection-v0"
        )
    if env in scenarios():  # of a file: who names a scenario with --env gets all that it says
        raise UserError(f"env: expected a highway-env id, got a scenario; give --env {env}")
    if f"{NAMESPACE}/{env}" not in ENV_IDS:
        known = [*scenarios(), *(id.removeprefix(f"{NAMESPACE}/") for id in ENV_IDS)]
        raise UserError(f"env: unknown environment or scenario {env!r}{nearest(env, known)}")


def scenario_name(config: TrainConfig) -> str:
    """The shipped scenario that a resolved configuration came from, else its highway-env id."""
    place = attrgetter("env", "env_config", "observation.goal")
    for name, path in scenarios().items():
        if place(load_config(path, trust=True)) == place(config):
            return name
    return config.env


def dump(config: Model) -> str:
    """YAML that ``load`` reads back to an equal configuration."""
    values = {"schema": SCHEMA, **config.model_dump(mode="json", exclude={"run_dir"})}
    return yaml_text.dump(values)
