"""What stands around an environment of a run: extra reward, statistics, given seeds, faults."""

from __future__ import annotations

import pickle
import random
import time
from collections.abc import Sequence
from math import isfinite
from typing import Any

import gymnasium as gym
import numpy as np

from esc_gym.measures import speed_along_lane, time_to_collision
from esc_gym.observation_type import SetSpec

REFERENCE_SPEED = 30.0  # m/s; ``progress_reward`` is paid for this much along the lane


class Progress(gym.Wrapper):
    """Pays for way made along the lane; optionally ends the episode off the road.

    Continuous highway tasks otherwise pay for spinning on the spot at full throttle.
    """

    def __init__(self, env: gym.Env, reward: float, offroad_terminal: bool) -> None:
        super().__init__(env)
        self.reward, self.offroad_terminal = reward, offroad_terminal

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        base: Any = self.unwrapped
        vehicle = base.vehicle
        progress = self.reward * speed_along_lane(vehicle) / REFERENCE_SPEED
        if self.offroad_terminal and not vehicle.on_road:
            terminated = True
        return observation, float(reward) + progress, terminated, truncated, info


class DrivingMonitor(gym.Wrapper):
    """``info["episode"]`` at the end of each episode, as SB3's Monitor gives it, and more.

    r return, l length [policy steps], t seconds since start; crashed (0 or 1), speed (mean, m/s),
    progress (way made along the lanes, m), off_road (share of the steps), lane_changes (count),
    vehicles (mean M), min_ttc (s; inf where nothing was ever on a collision course; computed with
    ``ttc=True`` only), seed (of the reset, None if there was none).
    """

    def __init__(self, env: gym.Env, ttc: bool = False) -> None:
        super().__init__(env)
        self.ttc = ttc
        self._start = time.time()

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._seed, self._rewards, self._speeds, self._counts = seed, [], [], []
        self._progress, self._off_road = 0.0, 0
        self._lane_changes, self._min_ttc = 0, float("inf")
        base: Any = self.unwrapped
        self._lane = base.vehicle.lane_index
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        base: Any = self.unwrapped
        vehicle, lane = base.vehicle, base.vehicle.lane_index
        self._rewards.append(float(reward))
        self._speeds.append(float(vehicle.speed))
        self._counts.append(info["set"]["count"])
        self._progress += speed_along_lane(vehicle) / base.config["policy_frequency"]
        self._off_road += not vehicle.on_road
        # Lane numbers of different roads are unrelated: only a change within one road counts.
        self._lane_changes += lane[:2] == self._lane[:2] and lane[2] != self._lane[2]
        self._lane = lane
        if self.ttc:
            self._min_ttc = min(self._min_ttc, time_to_collision(base))
        if terminated or truncated:
            info["episode"] = self._summary(vehicle.crashed)
        return observation, float(reward), terminated, truncated, info

    def _summary(self, crashed: bool) -> dict[str, Any]:
        return {
            "r": sum(self._rewards),
            "l": len(self._rewards),
            "t": time.time() - self._start,
            "crashed": int(crashed),
            "speed": float(np.mean(self._speeds)),
            "progress": float(self._progress),
            "off_road": self._off_road / len(self._rewards),
            "lane_changes": int(self._lane_changes),
            "vehicles": float(np.mean(self._counts)),
            "min_ttc": self._min_ttc,
            "seed": self._seed,
        }


class SeededEpisodes(gym.Wrapper):
    """Plays given seeds, one episode each, then rests: steps are no longer simulated."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self._seeds: list[int] = []
        self._last: Any = None

    def set_seeds(self, seeds: Sequence[int]) -> None:
        """The episodes to play, starting with the next reset."""
        self._seeds = list(seeds)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        self.resting = not self._seeds
        if self.resting and self._last is not None:
            return self._last, {}
        seed = self._seeds.pop(0) if self._seeds else seed
        self._last, info = self.env.reset(seed=seed, options=options)
        return self._last, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        if self.resting:
            return self._last, 0.0, False, False, {}
        return self.env.step(action)


def generators() -> tuple[Any, Any]:
    """The states of Python's and NumPy's generators of this process."""
    return random.getstate(), np.random.get_state()  # noqa: NPY002 (SB3 draws from it)


def set_generators(states: tuple[Any, Any]) -> None:
    """Go on where ``generators`` was called."""
    random.setstate(states[0])
    np.random.set_state(states[1])  # noqa: NPY002


class Worker(gym.Wrapper):
    """The outermost wrapper of an environment that a vectorised one steps, perhaps elsewhere.

    Gives and takes its whole state as bytes. What goes wrong, an exception or a number that is NaN
    or infinite, is told as ``info["fault"]``, from then on: raised in a process of its own it would
    only be lost.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.fault, self.episode, self.steps = "", -1, 0
        self._last: Any = None

    def state(self) -> bytes:
        """Everything that the future depends on, the process's generators included."""
        return pickle.dumps(
            (self.env, self.episode, self.steps, generators()), pickle.HIGHEST_PROTOCOL
        )

    def restore(self, state: bytes) -> None:
        """Go on where ``state`` was taken."""
        self.env, self.episode, self.steps, found = pickle.loads(state)
        set_generators(found)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        self.episode, self.steps = self.episode + 1, 0
        try:
            self._last, info = self.env.reset(seed=seed, options=options)
            self._check(self._last, 0.0, info)
            return self._last, info
        except Exception as error:
            self._note(error)
            return self._rest(), {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        if self.fault:
            return self._rest(), 0.0, False, False, {"fault": self.fault}
        self.steps += 1
        try:
            returned = self.env.step(action)
            self._check(returned[0], float(returned[1]), returned[4])
            self._last = returned[0]
            return returned
        except Exception as error:
            self._note(error)
            return self._rest(), 0.0, False, False, {"fault": self.fault}

    def _note(self, error: Exception) -> None:
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        self.fault = f"episode {self.episode}, step {self.steps}: {kind}{error}"

    def _rest(self) -> Any:
        if self._last is not None:
            return self._last
        spaces: Any = self.observation_space
        return {name: np.zeros(space.shape, space.dtype) for name, space in spaces.items()}

    def _check(self, observation: Any, reward: float, info: dict[str, Any]) -> None:
        spec, ids = self.get_wrapper_attr("set_spec"), info.get("set", {}).get("ids", ())
        if found := not_finite(observation, reward, spec, ids):
            raise ValueError(found)


def not_finite(observation: Any, reward: float, spec: SetSpec, ids: Sequence[int]) -> str:
    """What of a step is NaN or infinite, in words; "" if nothing is. ids: of the vehicles."""
    for name, columns in (("ego", spec.ego_features), ("vehicles", spec.features)):
        finite = np.isfinite(observation[name])
        if not finite.all():
            place = tuple(np.argwhere(~finite)[0].tolist())
            whose = "the ego"
            if name == "vehicles":
                number = f" (id {ids[place[0]]})" if place[0] < len(ids) else ""
                whose = f"vehicle {place[0]}{number}"
            return f"{columns[place[-1]]!r} of {whose} is {observation[name][place]}"
    return "" if isfinite(reward) else f"the reward is {reward}"
