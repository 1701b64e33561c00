"""Stable-Baselines3 feature extractors over the encoders: ``{ego, vehicles, mask}`` -> features.

    PPO("MultiInputPolicy", env, policy_kwargs={"features_extractor_class": ESCExtractor})

Shapes: B = batch, N = rows of the padded set, d1 = vehicle features, d2 = ego features.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor

from esc_gym.encoders import (
    DEFAULT_HIDDEN,
    REPRESENTATIONS as REPRESENTATIONS,
    APEncoder,
    representation as encoder_class,
)
from esc_gym.matching import matched_hidden


class SetExtractor(BaseFeaturesExtractor):
    """Encodes the observations of ``esc_gym.SetObservation`` for any SB3 algorithm.

    representation: a name in ``REPRESENTATIONS`` or "module:Class"; by default the class's own.
    hidden: widths of ESC's hidden layers. Other representations get widths with which they have as
        many parameters, unless ``match_parameters`` is false.
    encoder_kwargs: further arguments of the encoder, such as ``code_dim``, ``scale`` or ``sort``.
    """

    representation: str = "esc"

    def __init__(
        self,
        observation_space: spaces.Dict,
        representation: str | None = None,
        hidden: Sequence[int] | None = None,
        match_parameters: bool = True,
        **encoder_kwargs: Any,
    ) -> None:
        cls = encoder_class(representation or self.representation)
        vehicles, ego_dim = check_space(observation_space)
        # Goals are told as the ego sees them: four numbers.
        ego_dim += 4 * ("desired_goal" in observation_space.spaces)
        n, d1 = vehicles.shape
        settings = {"vehicle_dim": d1, "ego_dim": ego_dim, "max_vehicles": n, **encoder_kwargs}
        if issubclass(cls, APEncoder):
            # The scale of x and y, without which distances would not be in metres.
            settings = {"low": vehicles.low[0], "high": vehicles.high[0], **settings}
        hidden = DEFAULT_HIDDEN if hidden is None else tuple(hidden)
        if match_parameters:
            hidden = matched_hidden(cls, hidden=hidden, **settings)
        encoder = cls(hidden=hidden, **settings)
        super().__init__(observation_space, features_dim=encoder.features_dim)
        self.encoder = encoder

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """vehicles [B, N, d1], mask [B, N] as floats, ego [B, d2] -> [B, features_dim].

        Where the observation has goals [B, 6], x_else is ``ego`` and the goal as the ego sees it.
        """
        ego = observations["ego"]
        if "desired_goal" in observations:
            goal = goal_ahead(observations["achieved_goal"], observations["desired_goal"])
            ego = torch.cat([ego, goal], dim=-1)
        return self.encoder(observations["vehicles"], observations["mask"], ego)


def goal_ahead(achieved: Tensor, desired: Tensor) -> Tensor:
    """Goals [B, 6] as the ego sees them [B, 4]: forward, to the right, cosine, sine of the turn.

    As the ego features ``goal_x`` to ``goal_sin_h`` in the ego's frame, of any pair of goals, with
    20 m as 1: in highway-env's goals, where 100 m are 1, a spot is too small to learn to hit.
    """
    cosine, sine = achieved[..., 4], achieved[..., 5]
    vectors = 5 * (desired - achieved)[..., :2], desired[..., 4:]
    parts = [
        part
        for x, y in (vector.unbind(-1) for vector in vectors)
        for part in (cosine * x + sine * y, cosine * y - sine * x)
    ]
    return torch.stack(parts, dim=-1)


class ESCExtractor(SetExtractor):
    representation = "esc"


class ESCExpExtractor(SetExtractor):
    representation = "esc-exp"


class FPExtractor(SetExtractor):
    representation = "fp"


class APExtractor(SetExtractor):
    representation = "ap"


class MeanExtractor(SetExtractor):
    representation = "mean"


class MaxExtractor(SetExtractor):
    representation = "max"


class AttentionExtractor(SetExtractor):
    representation = "attention"


def check_space(space: spaces.Space) -> tuple[spaces.Box, int]:
    """The Box of the vehicles, and d2; a ValueError where ``space`` is no set observation's."""
    parts = space.spaces if isinstance(space, spaces.Dict) else {}
    ego, vehicles, mask = (parts.get(name) for name in ("ego", "vehicles", "mask"))
    if (
        isinstance(ego, spaces.Box)
        and len(ego.shape) == 1
        and isinstance(vehicles, spaces.Box)
        and len(vehicles.shape) == 2
        and isinstance(mask, spaces.MultiBinary)
        and mask.shape == vehicles.shape[:1]
    ):
        return vehicles, ego.shape[0]
    # Not the spaces themselves: their bounds print over many lines.
    got = {name: f"{type(part).__name__} {part.shape}" for name, part in parts.items()}
    raise ValueError(
        "observation_space: expected Dict(ego=Box (d2,), vehicles=Box (N, d1), "
        f"mask=MultiBinary(N)), got {got or type(space).__name__}; "
        "wrap the env with esc_gym.SetObservation"
    )
