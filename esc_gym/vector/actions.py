"""What highway-env's action types make of an action, for a batch of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from highway_env import utils
from highway_env.envs.common.action import ContinuousAction, DiscreteAction, DiscreteMetaAction

from esc_gym.fastsim.engine import COMMANDS, SPEED_STEPS
from esc_gym.fastsim.records import KEEP
from esc_gym.vector.arguments import actions_of

NO_ACTIONS, NO_CONTROLS = np.zeros(0, np.int64), np.zeros((0, 2))


class Actions:
    """A batch of actions as the kernels take it: meta-actions, or steering and acceleration."""

    def __init__(self, action_type: Any) -> None:
        self.type, self.space = action_type, action_type.space()
        self.meta = isinstance(action_type, DiscreteMetaAction)
        names = list(action_type.actions.values()) if self.meta else []
        self.commands = np.array([COMMANDS.get(name, KEEP) for name in names], np.int64)
        self.speed_steps = np.array([SPEED_STEPS.get(name, 0) for name in names], np.int64)
        self.target_speeds = np.array(action_type.target_speeds if self.meta else [0.0, 1.0], float)
        speed_range = getattr(action_type, "speed_range", None) or (np.inf, -np.inf)
        self.speed_range = np.array(speed_range, float)
        self.table = None
        if isinstance(action_type, DiscreteAction):
            self.table = np.array([self._controls(a) for a in range(action_type.space().n)])

    @staticmethod
    def unknown(action_type: Any) -> str:
        """Why a type of action cannot be done in a batch; "" if it can."""
        kind = type(action_type)
        if kind not in (DiscreteMetaAction, DiscreteAction, ContinuousAction):
            return f"action type {kind.__name__}"
        if kind is DiscreteMetaAction:
            speeds = action_type.target_speeds
            if len(speeds) < 2 or speeds[0] == speeds[-1]:
                return "target speeds that are all the same"
        return ""

    def checked(self, actions: Any, count: int) -> np.ndarray:
        """The batch as an array of the shape that the action space has, or ValueError."""
        return actions_of(actions, self.space, count)

    def taken(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(meta-actions [E], NO_CONTROLS), or (NO_ACTIONS, steering and acceleration [E, 2])."""
        if self.meta:
            return np.ascontiguousarray(actions, np.int64), NO_CONTROLS
        if self.table is not None:
            return NO_ACTIONS, self.table[actions]
        controls = np.empty((len(actions), 2))
        controls[:, 0], controls[:, 1] = self._split(actions)
        return NO_ACTIONS, controls

    def _split(self, actions: Any) -> tuple[Any, Any]:
        """(steering, acceleration): ``ContinuousAction.get_action``, in the actions' own type."""
        kind = self.type
        actions = np.clip(actions, -1, 1) if kind.clip else actions
        steering = acceleration = 0.0
        if kind.longitudinal:
            acceleration = utils.lmap(actions[:, 0], [-1, 1], kind.acceleration_range)
        if kind.lateral:
            steering = utils.lmap(actions[:, -1], [-1, 1], kind.steering_range)
        return steering, acceleration

    def _controls(self, action: int) -> tuple[float, float]:
        """(steering, acceleration) of a ``DiscreteAction``."""
        vehicle, taken = self.type.controlled_vehicle, {}
        own = vars(vehicle)
        own["act"] = taken.update
        try:
            self.type.act(action)
        finally:
            del own["act"]
        return float(taken["steering"]), float(taken["acceleration"])


def sizes_of(actions: np.ndarray) -> np.ndarray:
    """[E]: numbers of discrete actions, norms (``np.linalg.norm``) of others."""
    if actions.ndim == 1:
        return actions.astype(float)
    if actions.shape[1] == 1:
        return np.sqrt(actions[:, 0] * actions[:, 0]).astype(float)
    return np.array([np.linalg.norm(action) for action in actions], float)
