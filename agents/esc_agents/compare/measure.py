"""What is measured of a trained policy beside its return."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from torch import nn

from esc_agents import files
from esc_agents.compare.store import Baselines, OrderEffect
from esc_agents.config import TrainConfig
from esc_agents.driving.baselines import blind_drives, rule_driver
from esc_agents.driving.episodes import Episode, Summary, evaluate, model_policy
from esc_agents.driving.experts import PLANNER, reference_planner
from esc_agents.driving.rule_driver import RULE
from esc_agents.driving.vectorised import closing, vectorise
from esc_agents.errors import UserError, reason
from esc_gym.adaptation import adapt
from esc_gym.encoders import APEncoder, SetEncoder


def drive(config: TrainConfig, policy: Any, seeds: Sequence[int], **options: Any) -> list[Episode]:
    """Episodes of an SB3 policy. options: of ``make_env``.

    The environments may have another N than the policy was trained with, if its encoder takes any.
    """
    with _envs(config, policy, len(seeds), **options) as envs:
        return evaluate(envs, model_policy(policy), seeds)


def examine(
    config: TrainConfig, policy: Any, seeds: Sequence[int]
) -> tuple[list[Episode], OrderEffect, float | None]:
    """The same, with what the vehicles' order does to its decisions, and its slot churn."""
    with _envs(config, policy, len(seeds)) as envs:
        churn = SlotChurn(envs, encoder_of(policy))
        probe = OrderProbe(policy, config.seed, lambda: envs.get_attr("resting"))
        episodes = evaluate(churn, probe, seeds)
        return episodes, probe.effect(), churn.rate()


@contextmanager
def _envs(config: TrainConfig, policy: Any, episodes: int, **options: Any) -> Iterator[VecEnv]:
    made = vectorise(config, min(config.n_envs, episodes), evaluation=True, **options)
    with closing(made) as envs:
        adapt(policy, envs)
        yield envs


def baselines(config: TrainConfig, first_seed: int, episodes: int) -> Baselines:
    """Every blind policy of a scenario, IDM/MOBIL in the ego's place, and a planner; or why not.

    Raises UserError where no blind policy could drive.
    """
    evaluation = config.evaluation.model_copy(update={"seed": first_seed})
    config = config.model_copy(update={"evaluation": evaluation})
    seeds = range(first_seed, first_seed + episodes)
    drives = blind_drives(config, episodes)
    drives[RULE] = lambda: Summary.of(rule_driver(config, seeds))
    drives[PLANNER] = lambda: Summary.of(reference_planner(config, seeds))
    found, missing = {}, {}
    for name, driven in drives.items():
        try:
            found[name] = driven()
        except Exception as error:  # of one driver, which must not take the others with it
            missing[name] = reason(error)
    rule, planner = found.pop(RULE, None), found.pop(PLANNER, None)
    if not found:
        raise UserError(f"no blind policy could drive: {next(iter(missing.values()))}")
    return Baselines(found, rule, files.versions(), missing, planner)


def network_of(policy: Any) -> nn.Module:
    """The part of an SB3 policy that decides: SAC's actor, all of PPO's."""
    return getattr(policy, "actor", None) or policy


def encoder_of(policy: Any) -> SetEncoder:
    """The set encoder in a policy."""
    network: Any = network_of(policy)
    return network.features_extractor.encoder


class OrderProbe:
    """A policy that also asks itself what it would do were the vehicles in another order.

    resting: which environments have no episode left, and only repeat an observation.
    """

    def __init__(self, policy: Any, seed: int, resting: Callable[[], list[bool]]) -> None:
        self.policy, self.decide = policy, model_policy(policy)
        self.extract: Any = network_of(policy).features_extractor
        self.generator = np.random.default_rng(seed)
        self.resting = resting
        self.decisions, self.changed, self.largest = 0, 0.0, 0.0

    def __call__(self, observations: dict[str, NDArray]) -> NDArray:
        actions = self.decide(observations)
        other = shuffled(observations, self.generator)
        counted = ~np.array(self.resting())
        difference = np.abs(actions - self.decide(other)).reshape(len(actions), -1)
        if np.issubdtype(actions.dtype, np.integer):
            difference = difference != 0
        self.decisions += int(counted.sum())
        self.changed += float(difference.mean(axis=1)[counted].sum())
        self.largest = max(self.largest, self._difference(observations, other))
        return actions

    @torch.no_grad()
    def _difference(self, *observations: dict[str, NDArray]) -> float:
        tensors = [{k: torch.as_tensor(v).float() for k, v in o.items()} for o in observations]
        a, b = (self.extract(tensor) for tensor in tensors)
        return float((a - b).abs().max() / a.abs().max().clamp(min=1e-12))

    def effect(self) -> OrderEffect:
        """Over all decisions until now."""
        share = self.changed / self.decisions if self.decisions else 0.0
        return OrderEffect(self.decisions, share, self.largest)


def shuffled(
    observations: dict[str, NDArray], generator: np.random.Generator
) -> dict[str, NDArray]:
    """The same sets, the real rows of each in random order."""
    vehicles = observations["vehicles"].copy()
    for rows, mask in zip(vehicles, observations["mask"], strict=True):
        real = np.flatnonzero(mask)
        rows[real] = rows[generator.permutation(real)]
    return {**observations, "vehicles": vehicles}


class SlotChurn(VecEnvWrapper):
    """Counts how often a slot of fp or ap holds another vehicle than a step before.

    Slots that are empty before or after don't count.
    """

    def __init__(self, venv: VecEnv, encoder: SetEncoder) -> None:
        super().__init__(venv)
        self.encoder = encoder if isinstance(encoder, APEncoder) else None
        self.before: list[list[int]] = [[] for _ in range(venv.num_envs)]
        self.changed = self.total = 0

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        if self.encoder:
            for index, (done, info) in enumerate(zip(dones, infos, strict=True)):
                # The observation after the end of an episode is the next one's first.
                seen = "set" in info and not done
                now = self._slots(observations, index, info["set"]["ids"]) if seen else []
                pairs = list(zip(self.before[index], now, strict=False))
                self.changed += sum(old != new for old, new in pairs)
                self.total += len(pairs)
                self.before[index] = now
        return observations, rewards, dones, infos

    def _slots(self, observations: Any, index: int, ids: Sequence[int]) -> list[int]:
        """The ids of the vehicles in the slots, in order."""
        encoder: Any = self.encoder
        vehicles = torch.as_tensor(observations["vehicles"][index : index + 1])
        mask = torch.as_tensor(observations["mask"][index : index + 1]) != 0
        column = torch.full((1, vehicles.shape[1], 1), -1.0)
        column[0, : len(ids), 0] = torch.tensor(ids, dtype=torch.float)
        # The order looks at x and y only, so an id can ride along as one more column.
        arranged = encoder.arrange(torch.cat([vehicles, column], dim=2), mask)[0, :, -1]
        return arranged[: min(len(ids), encoder.slots)].int().tolist()

    def rate(self) -> float | None:
        """Share of the slots; None for an encoder without slots."""
        if not self.encoder:
            return None
        return self.changed / self.total if self.total else 0.0
