"""What highway-env's own driver would do in the ego's place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from numpy.typing import NDArray

from esc_gym.fastsim.kernel import EGO
from esc_gym.fastsim.records import IDM
from esc_gym.planning.guesses import nominal
from esc_gym.planning.rollouts import NEUTRAL, best, copies, meta_actions
from esc_gym.vector.arguments import indices_of
from esc_gym.vector.environment import SetVectorEnv


def idm_actions(
    envs: SetVectorEnv, indices: Sequence[int] | NDArray | None = None
) -> NDArray[np.int64]:
    """What IDM and MOBIL would do in the ego's place, as the nearest meta-action: [num_envs], or of
    ``indices``.

    That driver is as the scenario's are, may change lanes at once, and wants the highest
    target speed that the ego's meta-actions have. Nearest is the action that aims at the lane at
    which it aims, and after a policy step is nearest to its speed; of equally near ones IDLE.
    ValueError without meta-actions, or where the batch engine does not simulate this.
    """
    numbers = meta_actions(envs)
    chosen = indices_of(range(envs.num_envs) if indices is None else indices, envs.num_envs)
    tried = [*range(len(numbers)), numbers.get(NEUTRAL, 0)]  # the last one: the driver itself
    tries = copies(envs, np.repeat(chosen, len(tried)))
    state = tries.engine.state
    drivers = np.arange(len(tried) - 1, tries.num_envs, len(tried))
    places = drivers, state.counts[drivers, EGO]
    theirs = state.vehicles[places]
    theirs["kind"], theirs["changes_lanes"] = IDM, 1
    theirs["target_speed"] = tries.engine.env.unwrapped.action_type.target_speeds[-1]
    theirs["timer"] = IDMVehicle.LANE_CHANGE_DELAY
    for name, value in nominal(envs).items():
        theirs[name] = value
    state.vehicles[places] = theirs
    tries.advance(np.tile(tried, len(chosen)))
    egos = state.vehicles[np.arange(tries.num_envs), state.counts[:, EGO]]
    lanes, speeds = (egos[name].reshape(-1, len(tried)) for name in ("target_lane", "speed"))
    tries.close()
    nearness = -np.abs(speeds[:, :-1] - speeds[:, -1:])
    elsewhere = lanes[:, :-1] != lanes[:, -1:]
    nearness[elsewhere & ~elsewhere.all(axis=1, keepdims=True)] = -np.inf
    return best(nearness, numbers)
