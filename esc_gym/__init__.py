"""esc_gym: highway-env's traffic as a set, encoded by ESC, trained with Stable-Baselines3.

Importing this registers the Gymnasium ids ``esc_gym/<highway-env id>``. The names that need torch
or Stable-Baselines3 load when first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from esc_gym.fastsim import accelerate
from esc_gym.observation import SetObservation
from esc_gym.registration import ENV_IDS, register_envs

if TYPE_CHECKING:
    from esc_gym.adaptation import adapt as adapt
    from esc_gym.encoders import REPRESENTATIONS as REPRESENTATIONS
    from esc_gym.extractors import (
        APExtractor as APExtractor,
        AttentionExtractor as AttentionExtractor,
        ESCExpExtractor as ESCExpExtractor,
        ESCExtractor as ESCExtractor,
        FPExtractor as FPExtractor,
        MaxExtractor as MaxExtractor,
        MeanExtractor as MeanExtractor,
        SetExtractor as SetExtractor,
    )
    from esc_gym.sb3 import SetVecEnv as SetVecEnv

__version__ = "0.1.0"

_LAZY = {
    "adapt": "esc_gym.adaptation",
    "SetVecEnv": "esc_gym.sb3",
    "REPRESENTATIONS": "esc_gym.encoders",
    "SetExtractor": "esc_gym.extractors",
    "ESCExtractor": "esc_gym.extractors",
    "ESCExpExtractor": "esc_gym.extractors",
    "FPExtractor": "esc_gym.extractors",
    "APExtractor": "esc_gym.extractors",
    "MeanExtractor": "esc_gym.extractors",
    "MaxExtractor": "esc_gym.extractors",
    "AttentionExtractor": "esc_gym.extractors",
}

__all__ = ["ENV_IDS", "SetObservation", "__version__", "accelerate", *_LAZY]  # pyright: ignore


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'esc_gym' has no attribute {name!r}")
    return getattr(import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)


register_envs()
