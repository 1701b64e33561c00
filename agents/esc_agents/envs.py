"""Environments of a run: the set observation, the task's extra reward, driving statistics.

Worker processes import this module, which itself needs no torch.
"""

from __future__ import annotations

import os
import pickle
import random
import signal
import time
import warnings
from collections.abc import Callable, Sequence
from math import cos, isfinite
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator
from highway_env.vehicle.behavior import IDMVehicle
from numpy.typing import NDArray

from esc_agents.config import TrainConfig
from esc_agents.errors import UserError
from esc_agents.ttc import time_to_collision
from esc_gym.registration import NAMESPACE, merge, merge_config
from esc_gym.scenarios import scenario_of_class

REFERENCE_SPEED = 30.0  # m/s; ``progress_reward`` is paid for this much along the lane


def speed_along_lane(vehicle: Any) -> float:
    """What of a vehicle's speed brings it on along its lane [m/s]."""
    longitudinal, _ = vehicle.lane.local_coordinates(vehicle.position)
    return vehicle.speed * cos(vehicle.heading - vehicle.lane.heading_at(longitudinal))


class RuleDriver(gym.Wrapper):
    """Hands the ego over to highway-env's own driver, IDM and MOBIL, whatever actions are given.

    It wants the highest speed that the ego's meta-actions have, or the lane's limit.
    """

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        observation, info = self.env.reset(seed=seed, options=options)
        base: Any = self.unwrapped
        ego, vehicles = base.vehicle, base.road.vehicles
        speeds = getattr(ego, "target_speeds", (ego.MAX_SPEED,))
        kept: Any = {name: getattr(ego, name, None) for name in ("target_lane_index", "route")}
        driver = IDMVehicle(
            base.road, ego.position, ego.heading, ego.speed, target_speed=float(speeds[-1]), **kept
        )
        vehicles[vehicles.index(ego)] = driver
        base.vehicle = base.action_type.controlled_vehicle = driver
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """``action`` is replaced by the neutral one: some rewards look at it."""
        space: Any = self.action_space
        base: Any = self.unwrapped
        if isinstance(space, gym.spaces.Discrete):
            neutral: Any = base.action_type.actions_indexes["IDLE"]
        else:
            neutral = np.zeros(space.shape, space.dtype)
        return self.env.step(neutral)


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
        for name in ("ego", "vehicles"):
            finite = np.isfinite(observation[name])
            if not finite.all():
                first = np.argwhere(~finite)[0]
                value = observation[name][tuple(first)]
                raise ValueError(f"{self._place(name, first, info)} is {value}")
        if not isfinite(reward):
            raise ValueError(f"the reward is {reward}")

    def _place(self, name: str, index: NDArray, info: dict[str, Any]) -> str:
        spec = self.get_wrapper_attr("set_spec")
        if name == "ego":
            return f"{spec.ego_features[index[0]]!r} of the ego"
        row, column = index
        ids = info.get("set", {}).get("ids", ())
        vehicle = f" (id {ids[row]})" if row < len(ids) else ""
        return f"{spec.features[column]!r} of vehicle {row}{vehicle}"


def env_config(config: TrainConfig) -> dict[str, Any]:
    """The highway-env configuration of a run: the scenario's, changed by ``continuous`` for SAC."""
    preset = config.continuous.env_config if config.algo == "sac" and config.continuous else {}
    return merge(config.env_config, preset)


def check_actions(config: TrainConfig) -> None:
    """Raises UserError where algorithm and action space cannot meet, with the reason."""
    env_class: Any = load_env_creator(str(gym.registry[config.env].entry_point))
    action = merge_config(env_class.default_config(), env_config(config))["action"]["type"]
    scenario = scenario_of_class(env_class)
    reason = scenario.discrete_only if scenario else None
    wanted = "continuous actions" if config.algo == "ppo" else "--algo sac"
    if reason and (action == "ContinuousAction" or config.algo == "sac"):
        raise UserError(
            f"{wanted} on {config.env}: highway-env cannot do continuous actions here, since "
            f"{reason}; use --algo ppo with meta-actions"
        )
    if config.algo == "sac" and action != "ContinuousAction":
        raise UserError(
            f"--algo sac on {config.env}: expected continuous actions, got {action}; give the "
            "scenario a `continuous` section, or --env-config '{action: {type: ContinuousAction}}'"
        )


def make_env(
    config: TrainConfig,
    *,
    shuffle: bool = False,
    render_mode: str | None = None,
    evaluation: bool = False,
    rule_driver: bool = False,
) -> gym.Env:
    """One environment of a run.

    shuffle: permute the rows of every observation. evaluation: also measure times to collision.
    rule_driver: IDM and MOBIL drive the ego.
    """
    observation = config.observation.model_dump()
    if shuffle:
        observation["order"] = "shuffled"
    elif observation["order"] is None:
        observation["order"] = "shuffled" if config.repr == "ap" else "road"
    with warnings.catch_warnings():
        # The run names its version; Gymnasium's advice to take a newer one would change the task.
        warnings.filterwarnings("ignore", ".*is out of date.*", DeprecationWarning)
        env = gym.make(
            f"{NAMESPACE}/{config.env}",
            config=env_config(config),
            render_mode=render_mode,
            disable_env_checker=True,
            **observation,
        )
    if rule_driver:
        env = RuleDriver(env)
    task = config.continuous if config.algo == "sac" else None
    if task and (task.progress_reward or task.offroad_terminal):
        env = Progress(env, task.progress_reward, task.offroad_terminal)
    env = DrivingMonitor(env, ttc=evaluation)
    return SeededEpisodes(env) if evaluation else env


class EnvFactory:
    """Picklable ``make_env``, in a ``Worker``, for SB3's vectorised environments."""

    def __init__(self, config: TrainConfig, **options: Any) -> None:
        self.config, self.options, self.parent = config, options, os.getpid()

    def __call__(self) -> gym.Env:
        if os.getpid() != self.parent:
            # Ctrl-C reaches the whole process group; the parent decides when workers end.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        return Worker(make_env(self.config, **self.options))


def factories(config: TrainConfig, count: int, **options: Any) -> list[Callable[[], gym.Env]]:
    """``count`` factories of the run's environment."""
    return [EnvFactory(config, **options) for _ in range(count)]
