"""A policy as two files that hold no code: policy.safetensors and policy.json.

SB3's zip holds pickles, and to unpickle is to run whatever the file's author wanted. These files
hold numbers and names: weights, and what the network around them is built from.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load, save
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy, MultiInputActorCriticPolicy
from stable_baselines3.sac.policies import MultiInputPolicy as SACPolicy
from torch import Tensor

from esc_agents import files, pretrained, strangers
from esc_agents.config import TrainConfig
from esc_agents.driving.environments import other_meaning
from esc_agents.errors import UserError, say, wording
from esc_gym.adaptation import pinned_arguments
from esc_gym.extractors import SetExtractor
from esc_gym.observation_type import GOAL, GOALS

WEIGHTS, DESCRIPTION = "policy.safetensors", "policy.json"
POLICIES: dict[str, type[BasePolicy]] = {"ppo": MultiInputActorCriticPolicy, "sac": SACPolicy}


class _Described(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class BoxSpace(_Described):
    """gymnasium.spaces.Box of float32; bounds without leading axes along which they are equal."""

    type: Literal["box"] = "box"
    shape: tuple[int, ...]
    low: Any
    high: Any

    @classmethod
    def of(cls, space: spaces.Box) -> BoxSpace:
        return cls(shape=space.shape, low=_bound(space.low), high=_bound(space.high))

    def build(self) -> spaces.Box:
        low, high = (np.broadcast_to(np.float32(b), self.shape) for b in (self.low, self.high))
        return spaces.Box(low, high, dtype=np.float32)


class DiscreteSpace(_Described):
    """gymnasium.spaces.Discrete."""

    type: Literal["discrete"] = "discrete"
    n: int

    def build(self) -> spaces.Discrete:
        return spaces.Discrete(self.n)


class PolicyDescription(_Described):
    """Everything of a policy but its weights.

    sha256: of the file of weights. mac: see ``strangers.signed``. steps: of training. encoder:
    arguments of esc_gym's SetExtractor, all sizes said. observation: what wrapper.json of the run
    says, the meaning of the inputs. goal: whether they have parking's goal.
    """

    schema_version: Literal[1] = 1
    sha256: str
    mac: str = strangers.BLANK
    algo: Literal["ppo", "sac"]
    steps: int
    ego: BoxSpace
    vehicles: BoxSpace
    goal: bool = False
    action: BoxSpace | DiscreteSpace
    encoder: dict[str, Any]
    net_arch: tuple[int, ...]
    use_sde: bool = False
    observation: dict[str, Any]
    versions: dict[str, str]

    def build(self) -> BasePolicy:
        """The policy, its weights not yet loaded."""
        n = self.vehicles.shape[0]
        observation = spaces.Dict(
            {
                "ego": self.ego.build(),
                "vehicles": self.vehicles.build(),
                "mask": spaces.MultiBinary(n),
                **({name: GOAL for name in GOALS} if self.goal else {}),
            }
        )
        return POLICIES[self.algo](
            observation, self.action.build(), lambda _: 0.0,  # type: ignore[arg-type]
            net_arch=list(self.net_arch), use_sde=self.use_sde,
            features_extractor_class=SetExtractor,
            features_extractor_kwargs=self.encoder,
        )  # fmt: skip


def save_policy(
    folder: Path, model: BaseAlgorithm, config: TrainConfig, observation: dict[str, Any],
    name: str = "policy",
) -> None:  # fmt: skip
    """Write the policy of ``model`` as ``name``.safetensors and ``name``.json into ``folder``."""
    weights = save(_weights(model.policy))
    inputs: Any = model.observation_space
    action: Any = model.action_space
    description = PolicyDescription(
        sha256=hashlib.sha256(weights).hexdigest(),
        algo=config.algo,
        steps=model.num_timesteps,
        ego=BoxSpace.of(inputs["ego"]),
        vehicles=BoxSpace.of(inputs["vehicles"]),
        goal=GOALS[0] in inputs.spaces,
        action=DiscreteSpace(n=int(action.n))
        if isinstance(action, spaces.Discrete)
        else BoxSpace.of(action),
        encoder=pinned_arguments(model.policy),
        net_arch=config.hyperparameters.net_arch,
        use_sde=config.hyperparameters.use_sde,
        observation=observation,
        versions=files.versions(),
    )
    files.write_atomically(folder / f"{name}.safetensors", lambda file: file.write(weights))
    text = strangers.signed(description.model_dump_json(indent=2) + "\n")
    files.write_text(folder / f"{name}.json", text)


def start_from(
    policy: BasePolicy, source: str, algo: str, observation: dict[str, Any], trust: bool = False
) -> None:
    """Give an untrained policy the weights of another run, and say so.

    source: its directory, or zoo:NAME. observation: what wrapper.json says, of the policy's inputs.
    trust: as of ``load_policy``. Raises UserError where that run saw, did, or is built otherwise;
    then nothing has changed.
    """
    folder, description, weights = _run(source, trust)
    who, does = f"start_from {source}", description.action.build()
    if what := other_meaning(observation, description.observation):
        raise UserError(f"{who}: expected a run with the same observation, got {what}")
    if description.algo != algo or does != policy.action_space:
        raise UserError(
            f"{who}: expected a run of {algo} with the actions {policy.action_space}, got "
            f"{description.algo} and {does}"
        )
    mine = {key: tuple(tensor.shape) for key, tensor in _weights(policy).items()}
    theirs = {key: tuple(tensor.shape) for key, tensor in weights.items()}
    if mine != theirs:
        what = next(key for key in {**mine, **theirs} if mine.get(key) != theirs.get(key))
        raise UserError(
            f"{who}: expected the same network, got {what} {theirs.get(what)} there and "
            f"{mine.get(what)} here; repr, encoder, net_arch and max_vehicles have to agree"
        )
    ours = pinned_arguments(policy)  # the same shapes can still mean another code
    for name in sorted((ours.keys() | description.encoder.keys()) - {"max_vehicles"}):
        here, there = ours.get(name), description.encoder.get(name)
        if here != there:
            raise UserError(
                f"{who}: expected the same encoder, got {name} {there} there and {here} here"
            )
    _set_weights(policy, weights)
    say(f"Beginning with the weights of {folder}")


def load_driver(
    source: str, observation: dict[str, Any], actions: spaces.Space, trust: bool = False
) -> BasePolicy:
    """The policy of the run ``source``, to drive where ``observation`` and ``actions`` are.

    source, observation, trust: as of ``start_from``. Raises UserError where it does not know them.
    """
    folder, description, weights = _run(source, trust)
    if (does := description.action.build()) != actions:
        raise UserError(f"{source}: expected a run with the actions {actions}, got {does}")
    if what := other_meaning(observation, description.observation):
        raise UserError(f"{source}: expected a run with the same observation, got {what}")
    return _built(description, weights, folder / DESCRIPTION)


def _run(source: str, trust: bool) -> tuple[Path, PolicyDescription, dict[str, Tensor]]:
    """The directory that ``source`` means, and what its run ended with, else its best."""
    folder = pretrained.run_of(source)
    if not folder.is_dir():
        raise UserError(
            f"{folder} is no run directory: expected policy.json in it; train that run first, or "
            "give another"
        )
    name = next(
        (name for name in ("policy", "best_policy") if (folder / f"{name}.json").exists()), None
    )
    if name is None:
        raise UserError(
            f"{folder} holds no policy yet: expected a run that is finished, or evaluated"
        )
    if name != "policy":
        say(f"{folder} is not finished: its best policy so far is taken")
    return folder, *_read(folder, name, trust)


def load_policy(
    folder: Path, device: str = "cpu", name: str = "policy", trust: bool = False
) -> tuple[Any, int]:
    """(policy, training steps) from the two files; nothing is unpickled.

    trust: whether a description that this user did not write may name an encoder to import.
    Raises UserError where they are missing, damaged, or do not belong together.
    """
    description, weights = _read(folder, name, trust)
    return _built(description, weights, folder / f"{name}.json").to(device), description.steps


def _built(
    description: PolicyDescription, weights: dict[str, Tensor], described: Path
) -> BasePolicy:
    try:
        policy = description.build()
        _set_weights(policy, weights)
    except (RuntimeError, ValueError, TypeError) as error:
        raise UserError(f"{described} does not describe the weights beside it: {error}") from error
    policy.set_training_mode(False)
    return policy


def _read(folder: Path, name: str, trust: bool) -> tuple[PolicyDescription, dict[str, Tensor]]:
    described, stored = folder / f"{name}.json", folder / f"{name}.safetensors"
    try:
        data = described.read_bytes()
        description = PolicyDescription.model_validate_json(data)
        weights = stored.read_bytes()
    except FileNotFoundError as missing:
        raise UserError(f"{folder}: expected {Path(missing.filename).name} in it") from missing
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        problem = wording(f"{where}: {first['msg']}")
        raise UserError(f"{described} is damaged or of another version: {problem}") from error
    if hashlib.sha256(weights).hexdigest() != description.sha256:
        raise UserError(
            f"{stored} does not match the checksum in {described.name}: it is damaged, or its run "
            f"was killed between the two, and esc-train or esc-imitate --resume "
            f"{folder} writes them again"
        )
    strangers.check(described, data, description.encoder, trust)
    try:
        return description, load(weights)
    except SafetensorError as error:
        raise UserError(f"{described} does not describe the weights beside it: {error}") from error


def _weights(policy: BasePolicy) -> dict[str, Tensor]:
    """The state of a policy, each tensor once: SB3 has several names for a shared extractor."""
    found: dict[tuple[int, torch.Size], str] = {}
    state = policy.state_dict()
    for name, tensor in state.items():
        found.setdefault((tensor.data_ptr(), tensor.shape), name)
    return {name: state[name].contiguous().cpu() for name in found.values()}


def _set_weights(policy: BasePolicy, weights: dict[str, Tensor]) -> None:
    expected = _weights(policy).keys()
    if weights.keys() != expected:
        differing = sorted(weights.keys() ^ expected)
        raise ValueError(f"{len(differing)} names differ, such as {differing[0]}")
    policy.load_state_dict(weights, strict=False)  # other names of the same tensors are missing


def _bound(values: ArrayLike) -> Any:
    array = np.asarray(values)
    while array.ndim and (array == array[:1]).all():
        array = array[0]
    return array.tolist()
