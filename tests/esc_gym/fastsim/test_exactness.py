"""All of highway-env's environments, with their own action type and with continuous actions."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym
import pytest

from esc_gym.registration import HIGHWAY_ENV_IDS, MULTI_AGENT_IDS
from tests.esc_gym.fastsim.lockstep import lockstep

# The first prefix counts. Enough steps for the ends of roads and episodes; highway-v0 takes a
# quarter of a second each.
STEPS = {
    "highway-v0": 4,
    "intersection-v0": 13,
    "intersection-multi-agent": 6,
    "intersection": 8,
    "merge": 18,
    "racetrack": 12,
    "parking": 25,
    "lane-keeping": 60,
    "": 12,
}

TWO_AXES = {"action": {"type": "ContinuousAction"}}
# highway-env's rewards of merge and roundabout compare the action with numbers: one axis works.
ONE_AXIS = {"action": {"type": "ContinuousAction", "lateral": False}}
ALL_AGENTS = {"action": {"type": "MultiAgentAction", "action_config": TWO_AXES["action"]}}
KINEMATICS = {"observation": {"type": "Kinematics"}}


def continuous(env_id: str) -> dict[str, Any] | None:
    """The configuration for continuous actions; None: they are the default or do not work."""
    if env_id in MULTI_AGENT_IDS:
        return ALL_AGENTS
    if env_id.startswith(("lane-keeping", "parking", "two-way")) or env_id == "intersection-v1":
        return None
    if env_id.startswith(("merge", "roundabout")):
        return ONE_AXIS
    return TWO_AXES | (KINEMATICS if env_id.startswith("u-turn") else {})


CASES = [(env_id, {}) for env_id in HIGHWAY_ENV_IDS]
CASES += [(env_id, config) for env_id in HIGHWAY_ENV_IDS if (config := continuous(env_id))]


@pytest.mark.parametrize(
    ("env_id", "config"),
    [pytest.param(*case, id=case[0] + "-continuous" * bool(case[1])) for case in CASES],
)
def test_equal_to_the_last_bit(env_id, config, seeds):
    steps = next(count for prefix, count in STEPS.items() if env_id.startswith(prefix))
    # Not all ids take a config.
    lockstep(
        partial(gym.make, env_id, **{"config": config} if config else {}), seeds=seeds, steps=steps
    )
