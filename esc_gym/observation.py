"""highway-env's traffic as a padded set: ``{ego, vehicles, mask}``. No torch here.

Shapes: N = ``max_vehicles``, M = vehicles and solid obstacles within the perception distance,
d1 = vehicle features, d2 = ego features.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from math import copysign
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from highway_env import utils
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.observation import ObservationType
from highway_env.vehicle.behavior import IDMVehicle
from numpy.typing import NDArray

from esc_gym.behavior import Behavior, original_behavior
from esc_gym.features import (
    DEFAULT_FEATURES,
    EGO_FEATURES,
    VEHICLE_FEATURES,
    EgoView,
    Frame,
    Limits,
    default_row,
)
from esc_gym.scenarios import scenario_of

Order = Literal["road", "shuffled", "distance"]
Empty = Literal["zeros", "virtual"]
OnOverflow = Literal["warn", "error"]
Ranges = Mapping[str, tuple[float, float]]
Observation = dict[str, np.ndarray]


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
        return spaces.Dict(
            ego=spaces.Box(-1.0, 1.0, (len(self.spec.ego_features),), np.float32),
            vehicles=spaces.Box(np.tile(low, (n, 1)), np.tile(high, (n, 1)), (n, d1), np.float32),
            mask=spaces.MultiBinary(n),
        )

    def observe(self) -> Observation:
        """One observation: ``ego`` (d2,), ``vehicles`` (N, d1), ``mask`` (N,)."""
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
        return {"ego": self._ego(view), "vehicles": vehicles, "mask": mask}

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
        road: Any = self.env.road
        near = []
        for other in chain(road.vehicles, road.objects):
            other_x, other_y = other.position.tolist()
            dx = other_x - x
            if -reach < dx < reach:  # most vehicles of a long road end here
                dy = other_y - y
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


class _DefineSpaces:
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


class SetObservation(gym.Wrapper, RecordConstructorArgs):
    """Observe highway-env's traffic as a set.

    Observation: ``spaces.Dict`` of

    - ``ego``: Box float32 (d2,) in [-1, 1]: x_else, the ego and its road (``EGO_FEATURES``);
    - ``vehicles``: Box float32 (N, d1): the set, one row per vehicle or solid obstacle nearer than
      ``perception_distance``, in front and behind; rows past the M real ones are zero;
    - ``mask``: MultiBinary int8 (N,): 1 for the real rows.

    ``info["set"]`` has ``count`` (M), ``overflow`` (rows left out because M > N) and ``ids`` (row i
    is the same vehicle for as long as ``ids[i]`` is the same number).

    The set is computed inside ``env.step``, where highway-env computes its own observation, which
    is not computed any more. Trajectories and rewards are those of highway-env. Traffic parameters
    that another environment of the process changed for all (intersection-v0 does) do not reach
    this one.

    Args:
        env: a single-agent highway-env environment, as ``gym.make`` returns it.
        max_vehicles: N; default: as many as the scenario can hold, so that none is ever left out.
        features: columns of ``vehicles``, names in ``esc_gym.features.VEHICLE_FEATURES``.
        ego_features: entries of ``ego``, names in ``EGO_FEATURES``; default: the scenario's.
        perception_distance: radius of the set [m].
        order: rows as they are on the road, shuffled by a generator of the wrapper's own (never the
            simulator's; seeded by ``reset(seed=...)``), or nearest first.
        frame: ``"world"`` axes or the ego's body frame; default: ``"ego"`` where the road turns.
        ranges: ``{feature: (low, high)}`` mapped to [-1, 1], physical units; default: all that can
            occur. Vehicle values outside are not clipped but leave [-1, 1].
        empty: what M = 0 looks like: all rows zero, or one virtual vehicle far ahead (the paper's).
        on_overflow: ``"warn"`` once and keep the N nearest, or raise ``"error"``.

    Raises:
        TypeError: ``env`` is not a highway-env environment.
        ValueError: a bad argument, a multi-agent environment, or a wrapper between that changes
            the observation.
        OverflowError: from ``step``/``reset`` with ``on_overflow="error"``.

    Example:
        >>> import gymnasium as gym, highway_env
        >>> from esc_gym import SetObservation
        >>> env = SetObservation(gym.make("highway-fast-v0"))
        >>> observation, info = env.reset(seed=0)
        >>> observation["vehicles"].shape, int(observation["mask"].sum()) == info["set"]["count"]
        ((20, 7), True)
    """

    def __init__(
        self,
        env: gym.Env,
        max_vehicles: int | None = None,
        features: Sequence[str] = DEFAULT_FEATURES,
        ego_features: Sequence[str] | None = None,
        perception_distance: float = 200.0,
        order: Order = "road",
        frame: Frame | None = None,
        ranges: Ranges | None = None,
        empty: Empty = "zeros",
        on_overflow: OnOverflow = "warn",
    ) -> None:
        # Lists, not tuples, so that the spec survives JSON.
        RecordConstructorArgs.__init__(
            self,
            max_vehicles=max_vehicles,
            features=list(features),
            ego_features=ego_features and list(ego_features),
            perception_distance=perception_distance,
            order=order,
            frame=frame,
            ranges=ranges and {name: list(bounds) for name, bounds in ranges.items()},
            empty=empty,
            on_overflow=on_overflow,
        )
        super().__init__(env)
        base = _single_agent(env)
        scenario = scenario_of(base)
        ego_features = scenario.ego_features if ego_features is None else ego_features
        self.set_spec = SetSpec(
            max_vehicles=_count(max_vehicles, max(1, scenario.capacity(base.config))),
            features=_names("feature", features, VEHICLE_FEATURES),
            ego_features=_names("ego feature", ego_features, EGO_FEATURES),
            perception_distance=_positive("perception_distance", perception_distance),
            order=_choice("order", order, Order),
            frame=_choice("frame", frame or scenario.frame, Frame),
            ranges=_ranges(ranges or {}),
            empty=_choice("empty", empty, Empty),
            on_overflow=_choice("on_overflow", on_overflow, OnOverflow),
            limits=Limits.of(base.config, perception_distance),
        )
        self._install(base)
        self._behavior = Behavior()

    def _install(self, base: Any) -> None:
        base.define_spaces = _DefineSpaces(SetObservationType(base, self.set_spec))
        base.define_spaces()
        if self.env.observation_space != base.observation_space:
            raise ValueError(
                "SetObservation expected highway-env's own observation, but a wrapper inside it "
                f"changes the observation: {self.env}. Apply SetObservation first."
            )
        try:
            base.observation_type._ego(EgoView(base, self.set_spec.frame))
        except AttributeError as missing:
            raise ValueError(
                f"an ego feature in {self.set_spec.ego_features} does not exist in "
                f"{type(base).__name__}: {missing}"
            ) from missing

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Reset as highway-env does; ``seed`` also seeds the order ``"shuffled"``."""
        base: Any = self.unwrapped
        if seed is not None:
            base.observation_type.rng = np.random.default_rng([seed, 0x5E7])
        vehicle_type: Any = utils.class_from_path(base.config["other_vehicles_type"])
        with original_behavior(vehicle_type):
            observation, info = self.env.reset(seed=seed, options=options)
            self._behavior.learn({IDMVehicle, vehicle_type, *map(type, base.road.vehicles)})
        self._behavior.pin(base.road.vehicles)
        info["set"] = base.observation_type.info
        return observation, info

    def step(self, action: Any) -> tuple[Observation, Any, bool, bool, dict[str, Any]]:
        """Step as highway-env does, with the set as observation and in ``info["set"]``."""
        base: Any = self.unwrapped
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._behavior.pin(base.road.vehicles)
        info["set"] = base.observation_type.info
        # Some environments of highway-env return numpy.bool here, which SB3's checker refuses.
        return observation, reward, bool(terminated), bool(truncated), info

    def decode(self, observation: Mapping[str, NDArray]) -> Observation:
        """Physical units (m, m/s, 1) of an observation, or of a batch ``[..., N, d1]`` of them.

        Returns ``ego`` [..., d2], ``vehicles`` [..., N, d1] (float64, padded rows zero) and
        ``mask``; the columns are ``set_spec.ego_features`` and ``set_spec.features``.
        """
        base: Any = self.unwrapped
        kind = base.observation_type
        mask = np.asarray(observation["mask"])
        vehicles = kind.rows.decode(observation["vehicles"]) * (mask[..., None] != 0)
        return {"ego": kind.ego.decode(observation["ego"]), "vehicles": vehicles, "mask": mask}


def _single_agent(env: gym.Env) -> Any:
    base: Any = env.unwrapped
    if not isinstance(base, AbstractEnv):
        raise TypeError(
            f"SetObservation expected a highway-env environment, got {type(base).__name__}. "
            'Make one with gym.make("highway-v0") after import highway_env.'
        )
    if len(base.controlled_vehicles) > 1 or base.config["action"]["type"] == "MultiAgentAction":
        raise ValueError(
            f"SetObservation expected one controlled vehicle, got {len(base.controlled_vehicles)} "
            f"in {type(base).__name__}. Multi-agent environments are not supported; use the "
            "single-agent id, for example intersection-v0."
        )
    return base


def _count(value: int | None, default: int) -> int:
    if value is None:
        return default
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"max_vehicles: expected a whole number of at least 1, got {value!r}.")
    return int(value)


def _positive(name: str, value: float) -> float:
    if not 0 < value < float("inf"):
        raise ValueError(f"{name}: expected a positive finite number, got {value!r}.")
    return float(value)


def _choice(name: str, value: str, literal: Any) -> Any:
    if value not in get_args(literal):
        raise ValueError(f"{name}: expected one of {get_args(literal)}, got {value!r}.")
    return value


def _names(what: str, names: Sequence[str], table: Mapping[str, Any]) -> tuple[str, ...]:
    names = (names,) if isinstance(names, str) else tuple(names)
    unknown = [name for name in names if name not in table]
    if not names or unknown or len(set(names)) < len(names):
        raise ValueError(
            f"{what}s: expected distinct names among {', '.join(table)}; got {unknown or names}."
        )
    return names


def _ranges(ranges: Ranges) -> dict[str, tuple[float, float]]:
    known = {**VEHICLE_FEATURES, **EGO_FEATURES}
    for name, bounds in ranges.items():
        if name not in known:
            raise ValueError(f"ranges: expected names among {', '.join(known)}; got {name!r}.")
        if len(bounds) != 2 or not -float("inf") < bounds[0] < bounds[1] < float("inf"):
            raise ValueError(f"ranges[{name!r}]: expected (low, high), low < high; got {bounds}.")
    return {name: (float(low), float(high)) for name, (low, high) in ranges.items()}
