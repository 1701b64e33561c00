"""A trained model in other traffic: the same weights, another N."""

from __future__ import annotations

import warnings
from io import BytesIO
from typing import Any, TypeVar

import gymnasium as gym
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.vec_env import VecEnv

from esc_gym.extractors import SetExtractor, check_space

Model = TypeVar("Model", bound=BaseAlgorithm | BaseModel)


def adapt(model: Model, env: gym.Env | VecEnv) -> Model:
    """Make a Stable-Baselines3 model ready for an ``env`` with another N; returns the model.

        model = PPO.load("model.zip")  # trained among up to 20 vehicles
        env = gym.make("esc_gym/highway-v0", config={"vehicles_count": 80})
        model = esc_gym.adapt(model, env)

    Changes the model in place, as ``set_env`` does, after which it predicts, learns on, and is
    saved; ``PPO.load`` of what was saved needs nothing of this. All weights, optimizers and
    counters are kept, so the same vehicles lead to the same actions; d3 too, and so Theorem 1
    speaks of the N of training. As after ``load``, a ``seed`` that the model was made with seeds
    anew, and a replay buffer is empty (a warning says so if it was not).

    model: of any algorithm of SB3 or sb3-contrib, with a features extractor of esc_gym; or only its
        policy, which then just predicts. Its encoder takes any N: esc, esc-exp, mean, max,
        attention, and fp and ap with ``slots``.
    env: as the model's own, but for N; also another number of vectorised environments. Spaces don't
        name their columns: that both have the same ``features``, ``ego_features``, ``frame`` and
        ``perception_distance`` is for the caller to see to.

    Raises ValueError where they cannot meet: it says what differs.
    """
    policy = model.policy if isinstance(model, BaseAlgorithm) else model
    _check(policy, env)
    space, arguments = env.observation_space, pinned_arguments(policy)
    if isinstance(model, BaseAlgorithm):
        _reload(model, env, arguments)
    else:
        for module in policy.modules():
            if isinstance(module, BaseModel):
                module.observation_space, module.features_extractor_kwargs = space, arguments
    return model


def pinned_arguments(policy: BaseModel) -> dict[str, Any]:
    """Arguments of a policy's features extractor with which it is built alike for any N."""
    encoder = _encoder(policy)
    return {
        **policy.features_extractor_kwargs,
        "hidden": list(encoder.hidden),
        "code_dim": encoder.code_dim,
        "max_vehicles": encoder.max_vehicles,
        "match_parameters": False,
    }


def _reload(model: BaseAlgorithm, env: gym.Env | VecEnv, arguments: dict[str, Any]) -> None:
    """Save and load ``model``, for another space: SB3 makes the buffers and checks the rest."""
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None and buffer.size():
        warnings.warn(
            f"the {buffer.size() * buffer.n_envs} transitions in the replay buffer, of sets of "
            f"another N, are left behind",
            stacklevel=3,
        )
    file = BytesIO()
    model.save(file)
    file.seek(0)
    changed = {
        "observation_space": env.observation_space,
        "policy_kwargs": {**model.policy_kwargs, "features_extractor_kwargs": arguments},
    }
    twin = type(model).load(file, env=env, device=model.device, custom_objects=changed)
    vars(model).update(vars(twin), _custom_logger=model._custom_logger)


def _encoder(policy: BaseModel) -> Any:
    return next(part.encoder for part in policy.modules() if isinstance(part, SetExtractor))


def _check(policy: Any, env: gym.Env | VecEnv) -> None:
    kind = getattr(policy, "features_extractor_class", type(policy))
    if not issubclass(kind, SetExtractor):
        raise ValueError(
            f"model: expected one with a features extractor of esc_gym, got {kind.__name__}; only "
            "the extractors of sets take another N"
        )
    check_space(env.observation_space)
    here = _facts(env.observation_space, env.action_space)
    for name, expected in _facts(policy.observation_space, policy.action_space).items():
        if here[name] != expected:
            raise ValueError(
                f"{name}: expected {expected}, as in training, got {here[name]}; make the "
                "environment with the settings of the training"
            )
    rows, encoder = env.observation_space["mask"].n, _encoder(policy)  # type: ignore[index]
    if rows != encoder.max_vehicles and not encoder.any_size:
        raise ValueError(
            f"{type(encoder).__name__}: expected N = {encoder.max_vehicles}, as in training, got "
            f"{rows}; it takes another N only if trained with slots=Z"
        )


def _facts(space: Any, actions: spaces.Space) -> dict[str, Any]:
    """What has to agree whatever N is."""
    ego, vehicles = space["ego"], space["vehicles"]
    return {
        "ego features": ego.shape[0],
        "vehicle features": vehicles.shape[1],
        "ranges of the ego": [ego.low.tolist(), ego.high.tolist()],
        "ranges of vehicles": [vehicles.low[0].tolist(), vehicles.high[0].tolist()],
        "actions": actions,
    }
