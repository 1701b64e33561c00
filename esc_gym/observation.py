"""SetObservation, the wrapper: highway-env's traffic as ``{ego, vehicles, mask}``; no torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, get_args

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.parking_env import ParkingEnv
from numpy.typing import NDArray

from esc_gym import fastsim
from esc_gym.features import (
    DEFAULT_FEATURES,
    EGO_FEATURES,
    VEHICLE_FEATURES,
    EgoView,
    Frame,
    Limits,
)
from esc_gym.observation_type import (
    DefineSpaces,
    Empty,
    Observation,
    OnOverflow,
    Order,
    Ranges,
    SetObservationType,
    SetSpec,
)
from esc_gym.scenarios import scenario_of


class SetObservation(gym.Wrapper, RecordConstructorArgs):
    """Observe highway-env's traffic as a set.

    Observation: ``spaces.Dict`` of

    - ``ego``: Box float32 (d2,) in [-1, 1]: x_else, the ego and its road (``EGO_FEATURES``);
    - ``vehicles``: Box float32 (N, d1): the set, one row per vehicle or solid obstacle nearer than
      ``perception_distance``, in front and behind; rows past the M real ones are zero;
    - ``mask``: MultiBinary int8 (N,): 1 for the real rows;
    - with ``goal``, ``achieved_goal`` and ``desired_goal``: Box float64 (6,): x, y, vx, vy, cos_h
      and sin_h of the ego and of where it is to park, scaled as in highway-env's own observation.

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
        goal: parking's goal as keys of its own, which SB3's ``HerReplayBuffer`` takes with the
            environment's ``compute_reward``, instead of in ``ego``.
        accelerate: simulate with compiled code on exactly highway-env's trajectories
            (``esc_gym.accelerate``); False: with highway-env's own.

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
        goal: bool = False,
        accelerate: bool = True,
    ) -> None:
        for name, given in (("features", features), ("ego_features", ego_features)):
            if isinstance(given, str):
                raise ValueError(f"{name}: expected a sequence of names, got {given!r}.")
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
            goal=goal,
            accelerate=accelerate,
        )
        super().__init__(env)
        base = _single_agent(env)
        scenario = scenario_of(base)
        if goal and not isinstance(base, ParkingEnv):
            raise ValueError(f"goal: expected a parking environment, got {type(base).__name__}.")
        if ego_features is None:
            ego_features = [name for name in scenario.ego_features if not (goal and _of_goal(name))]
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
            goal=bool(goal),
            limits=Limits.of(base.config, perception_distance),
        )
        if goal and (named := [name for name in self.set_spec.ego_features if _of_goal(name)]):
            raise ValueError(
                f"ego_features: expected none of the goal with goal=True, got {', '.join(named)}; "
                "a replay buffer that puts other goals in its place would leave them as they are."
            )
        self._install(base)
        fastsim.isolate(base).enabled = accelerate

    def _install(self, base: Any) -> None:
        base.define_spaces = DefineSpaces(SetObservationType(base, self.set_spec))
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
        observation, info = self.env.reset(seed=seed, options=options)
        info["set"] = base.observation_type.info
        return observation, info

    def step(self, action: Any) -> tuple[Observation, Any, bool, bool, dict[str, Any]]:
        """Step as highway-env does, with the set as observation and in ``info["set"]``."""
        base: Any = self.unwrapped
        observation, reward, terminated, truncated, info = self.env.step(action)
        info["set"] = base.observation_type.info
        # Some environments of highway-env return numpy.bool here, which SB3's checker refuses.
        return observation, reward, bool(terminated), bool(truncated), info

    def action_masks(self) -> NDArray[np.bool_]:
        """Which meta-actions are available now: bool [number of actions].

        Not available: lane changes off the road, and speeds beyond the lowest and highest target
        speed. MaskablePPO of sb3-contrib asks for this, so that it takes our ids as they are:

            MaskablePPO("MultiInputPolicy", gym.make("esc_gym/highway-v0"),
                        policy_kwargs={"features_extractor_class": ESCExtractor})

        Raises ValueError where the actions are throttle and steering, all of them always available.
        """
        base: Any = self.unwrapped
        try:
            available = base.action_type.get_available_actions()
        except NotImplementedError:
            raise ValueError(
                "action_masks: expected meta-actions, got "
                f"{base.config['action']['type']}, whose actions are always available; use "
                "DiscreteMetaAction, or an algorithm without masks."
            ) from None
        return np.isin(np.arange(base.action_space.n), available)

    @property
    def compute_reward(self) -> Any:
        """highway-env's reward of (achieved, desired, info), goals [6] or batches [B, 6] of them.

        Raises AttributeError without ``goal=True``: who has it is a goal environment to SB3.
        """
        base: Any = self.unwrapped
        return base.compute_reward

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


def _of_goal(ego_feature: str) -> bool:
    return ego_feature.startswith("goal_")


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
