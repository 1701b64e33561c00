"""The set as one of highway-env's own observation types: what ``observe`` reads off the road.

Shapes: N = ``max_vehicles``, M = vehicles and solid obstacles within the perception distance,
d1 = vehicle features, d2 = ego features.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from math import copysign
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.observation import ObservationType
from numpy.typing import NDArray

from esc_gym.features import (
    DEFAULT_FEATURES,
    EGO_FEATURES,
    VEHICLE_FEATURES,
    EgoView,
    Frame,
    Limits,
    default_row,
)

Order = Literal["road", "shuffled", "distance"]
Empty = Literal["zeros", "virtual"]
OnOverflow = Literal["warn", "error"]
Ranges = Mapping[str, tuple[float, float]]
Observation = dict[str, np.ndarray]
# Keys of parking's goal, and their space: x, y, vx, vy, cos_h, sin_h, scaled by highway-env.
GOALS = ("achieved_goal", "desired_goal")
GOAL = spaces.Box(-np.inf, np.inf, (6,), np.float64)


class MinMax:
    """Fixed min-max scaling of columns to [-1, 1].

    ranges: (low, high) that map to -1 and 1. bounds: physical (low, high) of the values; where they
    are wider than the range, the scaled value leaves [-1, 1] and ``low``/``high`` say how far.
    """

    def __init__(self, ranges: Sequence[tuple[float, float]], bounds: Sequence) -> None:
        low, high = np.array(ranges, dtype=np.float64).reshape(-1, 2).T
        self.center, self.half = (high + low) / 2, (high - low) / 2
        self._shifted = bool(self.center.any())
        limits = np.array(bounds, dtype=np.float64).reshape(-1, 2).T
        self.low, self.high = ((limits - self.center) / self.half).astype(np.float32)

    def encode(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Scale ``values`` [..., columns] in place."""
        if self._shifted:
            values -= self.center
        values /= self.half
        return values

    def decode(self, scaled: NDArray) -> NDArray[np.float64]:
        return np.asarray(scaled, dtype=np.float64) * self.half + self.center


@dataclass(frozen=True)
class SetSpec:
    """Everything that fixes an observation, validated: what ``wrapper.json`` keeps of a run."""

    max_vehicles: int
    features: tuple[str, ...]
    ego_features: tuple[str, ...]
    perception_distance: float
    order: Order
    frame: Frame
    ranges: dict[str, tuple[float, float]]
    empty: Empty
    on_overflow: OnOverflow
    goal: bool
    limits: Limits = field(repr=False)

    def scale(self, table: Mapping[str, Any], names: Sequence[str]) -> MinMax:
        bounds = [table[name].bounds(self.limits) for name in names]
        ranges = [self.ranges.get(name) or bound for name, bound in zip(names, bounds, strict=True)]
        return MinMax(ranges, bounds)


class SetObservationType(ObservationType):
    """The set, in highway-env's own terms: computed where stock Kinematics would be.

    ``observe()`` also leaves ``info`` = {"count": M, "overflow": left out, "ids": one per row}.
    """

    def __init__(self, env: AbstractEnv, spec: SetSpec) -> None:
        super().__init__(env)
        self.spec, self.rng = spec, np.random.default_rng()
        self.info: dict[str, Any] = {"count": 0, "overflow": 0, "ids": ()}
        self._warned = False
        self._compile()

    def _compile(self) -> None:
        """Look the features up in their tables, whose functions do not pickle."""
        spec = self.spec
        self.rows = spec.scale(VEHICLE_FEATURES, spec.features)
        self.ego = spec.scale(EGO_FEATURES, spec.ego_features)
        extra = [name for name in spec.features if name not in DEFAULT_FEATURES]
        self._extra_getters: list[Any] = [VEHICLE_FEATURES[name].get for name in extra]
        computed = [*DEFAULT_FEATURES, *extra]
        columns = [computed.index(name) for name in spec.features]
        self._columns = None if list(spec.features) == computed else columns
        getters = [EGO_FEATURES[name].get for name in spec.ego_features]
        self._ego_columns = list(
            zip(getters, self.ego.center.tolist(), self.ego.half.tolist(), strict=True)
        )

    def __getstate__(self) -> dict[str, Any]:
        compiled = ("rows", "ego", "_extra_getters", "_columns", "_ego_columns")
        return {name: value for name, value in vars(self).items() if name not in compiled}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._compile()

    def space(self) -> spaces.Dict:
        n, d1 = self.spec.max_vehicles, len(self.spec.features)
        # Zero rows must lie in the space whatever the ranges.
        low, high = np.minimum(self.rows.low, 0), np.maximum(self.rows.high, 0)
        low, high = np.tile(low, (n, 1)), np.tile(high, (n, 1))
        return spaces.Dict(
            {
                "ego": spaces.Box(-1.0, 1.0, (len(self.spec.ego_features),), np.float32),
                "vehicles": spaces.Box(low, high, (n, d1), np.float32),
                "mask": spaces.MultiBinary(n),
                **({name: GOAL for name in GOALS} if self.spec.goal else {}),
            }
        )

    def observe(self) -> Observation:
        """One observation: ``ego`` (d2,), ``vehicles`` (N, d1), ``mask`` (N,), goals (6,)."""
        view = EgoView(self.env, self.spec.frame)
        near = self._perceived(view)
        vehicles = np.zeros((self.spec.max_vehicles, len(self.spec.features)), np.float32)
        mask = np.zeros(self.spec.max_vehicles, np.int8)
        kept = self._kept(near)
        if kept:
            rows = np.array([row for _, row, _ in kept])
            rows = rows if self._columns is None else rows[:, self._columns]
            vehicles[: len(kept)] = self.rows.encode(rows)
            mask[: len(kept)] = 1
        elif self.spec.empty == "virtual":
            vehicles[0], mask[0] = self._virtual_row(), 1
        ids = tuple([number for _, _, number in kept])
        self.info = {"count": len(near), "overflow": len(near) - len(kept), "ids": ids}
        observation = {"ego": self._ego(view), "vehicles": vehicles, "mask": mask}
        if self.spec.goal:
            goals = self.env.observation_type_parking.observe()  # type: ignore[attr-defined]
            observation |= {name: goals[name] for name in GOALS}
        return observation

    def _ego(self, view: EgoView) -> NDArray[np.float32]:
        # Scalars, not arrays: d2 is about ten, and NumPy's calls would cost more than the numbers.
        values = [
            copysign(1.0, value)
            if (value := (get(view) - center) / half) > 1.0 or value < -1.0
            else value
            for get, center, half in self._ego_columns
        ]
        return np.array(values, np.float32)

    def _perceived(self, view: EgoView) -> list[tuple[float, tuple[float, ...], int]]:
        """(squared distance, physical feature values, id) of all that is perceived, in road order.

        The values are in the order default features, then extra ones.
        """
        x, y, ego = view.x, view.y, view.vehicle
        reach = self.spec.perception_distance
        limit = reach * reach
        behind, ahead = x - reach - 1.0, x + reach + 1.0
        road: Any = self.env.road
        near = []
        for other in chain(road.vehicles, road.objects):
            if behind < other.position.item(0) < ahead:  # most vehicles of a long road are not
                other_x, other_y = other.position.tolist()
                dx, dy = other_x - x, other_y - y
                squared = dx * dx + dy * dy
                if squared < limit and other is not ego and other.solid:
                    row = default_row(view, other, dx, dy)
                    if extra := self._extra_getters:
                        row = (*row, *[get(view, other) for get in extra])
                    near.append((squared, row, self._id(other)))
        return near

    def _kept(self, near: list) -> list:
        """At most N objects, the nearest, in the order asked for."""
        excess = len(near) - self.spec.max_vehicles
        if excess > 0:
            self._overflow(len(near))
            # Ranks instead of sorting in place: the survivors stay in road order.
            ranks = sorted(range(len(near)), key=lambda i: near[i][0])
            near = [near[i] for i in sorted(ranks[:-excess])]
        if self.spec.order == "distance":
            near.sort(key=lambda item: item[0])
        elif self.spec.order == "shuffled":
            near = [near[i] for i in self.rng.permutation(len(near))]
        return near

    def _overflow(self, count: int) -> None:
        n = self.spec.max_vehicles
        message = (
            f"{count} vehicles within {self.spec.perception_distance:g} m, but max_vehicles={n}: "
            f"the {n} nearest are kept. Raise max_vehicles to {count} or more to keep all; "
            "info['set']['overflow'] counts those left out."
        )
        if self.spec.on_overflow == "error":
            raise OverflowError(message)
        if not self._warned:
            warnings.warn(message, stacklevel=6)
            self._warned = True

    def _virtual_row(self) -> NDArray[np.float64]:
        """The paper's virtual vehicle: at the perception limit ahead, moving as the ego does."""
        raw = {"x": self.spec.perception_distance, "cos_h": 1.0, "length": 5.0, "width": 2.0}
        return self.rows.encode(np.array([raw.get(name, 0.0) for name in self.spec.features]))

    def _id(self, vehicle: Any) -> int:
        # Kept on the simulator's objects, so that it survives deepcopy and pickling, and counts
        # from 0 again on the new road of the next episode.
        try:
            return vehicle.set_id
        except AttributeError:
            road = vars(self.env.road)
            vehicle.set_id = road["set_ids"] = road.get("set_ids", -1) + 1
            return vehicle.set_id


class DefineSpaces:
    """Replaces ``define_spaces`` on one environment; a class, since it must pickle and copy."""

    def __init__(self, observation_type: SetObservationType) -> None:
        self.observation_type = observation_type
        self.space = observation_type.space()

    def __call__(self) -> None:
        env = self.observation_type.env
        stock = env.config["observation"]
        env.config["observation"] = {"type": "Kinematics"}  # its space() is free; others observe
        try:
            type(env).define_spaces(env)
        finally:
            env.config["observation"] = stock
        env.observation_type, env.observation_space = self.observation_type, self.space
