"""The smallest imitation: seconds; six vehicles, a planner that looks two steps ahead."""

from __future__ import annotations

from typing import Any

from esc_agents.imitation.settings import CollectConfig, ImitateConfig
from tests.esc_agents.tiny import RANGES, ROAD

PLANNER = {"horizon": 2, "free": 1}
OBSERVATION = {"ranges": RANGES}


def small(**changes: Any) -> ImitateConfig:
    """Two rounds of at least 20 labels, in highway-fast."""
    values = {
        "env": "highway-fast", "expert": "planner", "planner": PLANNER, "labels": 20, "rounds": 1,
        "epochs": 2, "batch_size": 64, "device": "cpu", "env_config": ROAD,
        "observation": OBSERVATION, "encoder": {"hidden": (8,), "code_dim": 200}, **changes,
    }  # fmt: skip
    return ImitateConfig.model_validate(values)


def gathered(**changes: Any) -> CollectConfig:
    """Five episodes of the same."""
    values = {
        "env": "highway-fast", "planner": PLANNER, "episodes": 5, "n_envs": 2, "env_config": ROAD,
        **changes,
    }  # fmt: skip
    return CollectConfig.model_validate(values)
