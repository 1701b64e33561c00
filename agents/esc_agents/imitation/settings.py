"""What is to be labelled, by whom, and how one learns from it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from esc_agents.config import (
    EncoderConfig,
    Episodes,
    Model,
    ObservationConfig,
    Probability,
    Seed,
    Size,
    Threads,
    TrainConfig,
    config_for_env,
)
from esc_agents.driving.planner_config import PlannerConfig
from esc_agents.yaml_text import Mapping
from esc_gym.registration import merge

Loss = Literal["values", "cross-entropy", "regret"]


class CollectConfig(Model):
    """Episodes with what an expert thinks of every step."""

    env: str = "highway-v0"
    """highway-env id (highway-v0), or the name of a scenario (highway-dense)."""
    expert: str = "planner"
    """Who labels: planner, idm (what IDM and MOBIL would do, as the nearest meta-action), or
    run:DIR (the policy of a run)."""
    planner: PlannerConfig = PlannerConfig()
    """Of the expert planner."""
    episodes: Episodes = 100
    noise: Probability = 0.2
    """Share of the steps in which a random action is taken: the labels are the expert's all the
    same, also of states into which it would not have come."""
    seed: Seed = 0
    """Seed of the first episode; the others follow."""
    n_envs: Size = 64
    """Environments that are driven at once."""
    env_config: Mapping = Field(default_factory=dict)
    """highway-env configuration, merged into the scenario's."""
    observation: ObservationConfig | None = None
    """What is seen; default: the scenario's."""

    def train_config(self) -> TrainConfig:
        """The scenario, as runs in it have it."""
        base = config_for_env(self.env)
        changes = {
            "env_config": merge(base.env_config, self.env_config),
            "algo": "ppo", "n_envs": self.n_envs, "seed": self.seed,
            "observation": self.observation or base.observation,
        }  # fmt: skip
        return base.model_copy(update=changes)


class ImitateConfig(Model):
    """Supervised training of a policy on an expert's labels, and then, in rounds, on labels of what
    it meets itself (DAgger; Ross, Gordon and Bagnell, 2011)."""

    env: str = "highway-v0"
    """highway-env id (highway-v0), or the name of a scenario (highway-dense)."""
    repr: str = "esc"
    """Representation: esc, esc-exp, fp, ap, mean, max, attention, or module:Class."""
    expert: str | None = None
    """Who labels: planner, idm, or run:DIR; with --data it labels the rounds only."""
    data: Path | None = None
    """Directory that esc-collect wrote, to begin with."""
    planner: PlannerConfig = PlannerConfig()
    """Of the expert planner."""
    labels: PositiveInt = 4000
    """Labels in each round, to the end of the last episode."""
    noise: Probability = 0.2
    """Share of the steps in which a random action is taken while the expert drives."""
    portions: PositiveInt = 1
    """Of --data: learn anew from growing parts of it, each of twice as many episodes as the one
    before, the last one of all: how regret falls with the number of labels."""
    rounds: NonNegativeInt | None = None
    """Rounds in which the learner drives and the expert labels what it meets; default: 4, without
    an expert 0."""
    loss: Loss = "cross-entropy"
    """cross-entropy: beside softmax(values / temperature), so that ties share, and what is nearly
    as good counts; values: squared error of the values of all actions; regret: what the learner's
    choices are worth less than the best."""
    temperature: PositiveFloat = 0.25
    """In units of how much values differ between the actions of one state."""
    epochs: PositiveInt = 30
    """Passes over all labels so far, in each round."""
    batch_size: Annotated[int, Field(ge=2)] = 512
    learning_rate: PositiveFloat = 1e-3
    """At the beginning of each round; falls to 0 within it."""
    seed: Seed = 0
    threads: Threads = 1
    """torch's threads on the CPU."""
    device: str = "auto"
    """torch device: auto, cpu, cuda, cuda:1."""
    env_config: Mapping = Field(default_factory=dict)
    """highway-env configuration, merged into the scenario's."""
    observation: ObservationConfig = ObservationConfig()
    encoder: EncoderConfig = EncoderConfig()
    start_from: str | None = None
    """Begin with the weights of another run: its directory, or zoo:NAME."""
    run_dir: Path | None = None
    """New directory for the run; default: runs/<scenario>-<repr>-imitation-<seed>-<time>."""

    @property
    def dagger_rounds(self) -> int:
        """``rounds``, with its default."""
        if self.rounds is None:
            return 4 if self.expert else 0
        return self.rounds

    def train_config(self) -> TrainConfig:
        """The same run as esc-train's would be, with the scenario's PPO settings."""
        base = config_for_env(self.env)
        changes = {
            name: getattr(self, name)
            for name in ("repr", "seed", "threads", "device", "observation", "encoder",
                         "start_from", "run_dir")
        }  # fmt: skip
        changes["env_config"] = merge(base.env_config, self.env_config)
        labels = (self.dagger_rounds + 1) * self.labels
        return base.model_copy(update={**changes, "algo": "ppo", "steps": labels})
