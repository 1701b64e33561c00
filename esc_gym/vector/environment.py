"""``SetVectorEnv``: many environments of one id as a Gymnasium vector environment."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space

from esc_gym import fastsim
from esc_gym.registration import check_arguments, make
from esc_gym.vector.arguments import (
    actions_of,
    at_least_one,
    mask_of,
    mode_of,
    seeds_of,
)
from esc_gym.vector.engine import Engine
from esc_gym.vector.families import Report, family_of
from esc_gym.vector.in_hand import StateInHand
from esc_gym.vector.infos import (
    Infos,
    add_final,
    add_step,
    infos_of,
    rows,
    singly,
    told,
    with_ids,
)
from esc_gym.vector.kernel import TERMINATED, TRUNCATED
from esc_gym.vector.measures import Measured
from esc_gym.vector.objects import measured, reset_quietly
from esc_gym.vector.state import ENDED, RESTING


class SetVectorEnv(StateInHand):
    """``num_envs`` environments of one id, observed as sets; what ``gym.make_vec`` makes of ours.

    Environment i, reset with seed s, gives to the last bit what ``gym.make`` of the same id with
    seed s gives: observations, rewards, ends, infos, over resets too. State lives in arrays
    and one compiled call steps all of them; a configuration that the engine does not know runs
    one environment after the other, with the same results, and ``report()`` says why.

    Args:
        base_id: the highway-env id.
        num_envs: how many.
        config: merged into that id's default configuration, as for ``gym.make``.
        threads: that share the environments out among them; results do not depend on it.
        autoreset_mode: what follows the end of an episode, as in ``gymnasium.vector``:
            ``"NextStep"``, ``"SameStep"`` or ``"Disabled"``.
        max_episode_steps: policy steps until an episode is truncated; None: as the id says.
        render_mode: None or ``"rgb_array"``.
        copy: return copies of observations; False: the arrays that the next step overwrites.
        set_observation: arguments of ``SetObservation``.

    ``info`` has, each with its mask ``_name``: ``speed``, ``crashed``, ``action``, ``rewards`` (a
    dictionary by name) and ``set`` (``count``, ``overflow``, and ``ids`` [num_envs, N], -1 past the
    real rows); after a step of lane-keeping only ``set``, as in highway-env. The action that
    highway-env draws at a reset to fill its info is left out, with what it would have earned.

    Raises ValueError for bad arguments and actions.

    Example:
        >>> import gymnasium as gym, esc_gym
        >>> envs = gym.make_vec("esc_gym/highway-fast-v0", num_envs=4)
        >>> observations, infos = envs.reset(seed=0)
        >>> observations["vehicles"].shape
        (4, 20, 7)
    """

    def __init__(
        self,
        base_id: str,
        num_envs: int = 1,
        config: Mapping[str, Any] | None = None,
        threads: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        copy: bool = True,
        **set_observation: Any,
    ) -> None:
        check_arguments(set_observation, SetVectorEnv)
        self.num_envs = at_least_one("num_envs", num_envs)
        threads = at_least_one("threads", threads)
        mode = self.autoreset_mode = mode_of(autoreset_mode)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: expected None or 'rgb_array', got {render_mode!r}.")
        self.render_mode, self.copy = render_mode, copy
        unlimited = max_episode_steps in (None, -1)
        self._limit = 0 if unlimited else at_least_one("max_episode_steps", max_episode_steps)

        def make_one(render_mode: str | None = render_mode) -> gym.Env:
            env: gym.Env = make(base_id, config, render_mode, **set_observation)
            return gym.wrappers.TimeLimit(env, self._limit) if self._limit else env

        self._make_one: Callable[..., gym.Env] = make_one
        env = make_one()
        self.set_spec = env.get_wrapper_attr("set_spec")
        self.metadata = {**env.metadata, "autoreset_mode": mode, "render_modes": ["rgb_array"]}
        self.single_observation_space, self.single_action_space = (
            env.observation_space, env.action_space,
        )  # fmt: skip
        base: Any = env.unwrapped
        self.config = {**base.config, "observation": None}
        self._task = base_id, self.config
        reset_quietly(env)
        accelerated = set_observation.get("accelerate", True)
        family, self._reason = family_of(base) if accelerated else (None, "accelerate=False")
        self._warned = False
        self.engine: Any = None  # the ``Engine``, where it simulates this
        self._envs: Any = None
        self._infos: Infos = {}  # of the last step, without an engine
        self._roads: dict[tuple[Any, Any], int] = {}  # numbers of roads, of ``measure``
        if family:
            self.engine = Engine(env, family, self.num_envs, threads, self._limit, mode)
        else:
            ordered = [lambda: gym.wrappers.OrderEnforcing(make_one())] * self.num_envs
            self._envs = SyncVectorEnv(ordered, copy, autoreset_mode=mode)
            env.close()

    @cached_property
    def observation_space(self) -> gym.Space:  # type: ignore[override]
        return batch_space(self.single_observation_space, self.num_envs)

    @cached_property
    def action_space(self) -> gym.Space:  # type: ignore[override]
        return batch_space(self.single_action_space, self.num_envs)

    def report(self) -> Report:
        """Whether the batch engine simulates this, and if not, why."""
        reports = () if self.engine else tuple(map(fastsim.report, self._envs.envs))
        return Report(self.engine is not None, self._reason, reports)

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The generators of the environments; copies, drawing from them changes nothing."""
        return self.engine.generators() if self.engine else self._envs.np_random

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seeds with which the environments began; -1 where not known, or 2**63 and more."""
        if not self.engine:
            return self._envs.np_random_seed
        return tuple(self.engine.state.heads["seed"].tolist())

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[dict[str, np.ndarray], Infos]:
        """Reset all environments, or those that ``options["reset_mask"]`` (bool [num_envs]) names.

        seed: environment i gets seed + i; or one seed for each; None: go on drawing.
        """
        if not isinstance(options, Mapping | None):
            raise ValueError(f"options: expected a mapping, got {options!r}.")
        options = dict(options or {})
        seeds = seeds_of(seed, self.num_envs)
        name, everywhere = "options['reset_mask']", np.ones(self.num_envs, bool)
        mask = mask_of(options.pop("reset_mask", everywhere), self.num_envs, name)
        if not mask.any():
            raise ValueError(f"{name}: expected at least one environment to reset.")
        if options:
            raise ValueError(
                f"options: expected nothing but 'reset_mask', got {', '.join(options)}; another "
                "configuration is for gym.make_vec(..., config=...)."
            )
        observation = self.begin(seeds, mask)
        if not self.engine:
            return observation, self._infos
        return observation, infos_of(self.engine, self.engine.now, mask)

    def begin(self, seeds: Sequence[int | None], mask: np.ndarray) -> dict[str, np.ndarray]:
        """``reset`` of the environments of ``mask`` without infos, for which see ``told``."""
        self._check_open()
        if not self.engine:
            options = None if mask.all() else {"reset_mask": mask}
            observation, infos = self._envs.reset(seed=list(seeds), options=options)
            self._infos = with_ids(infos, self.num_envs, self.set_spec.max_vehicles)
            return observation
        self.engine.reset(seeds, mask)
        self._note_overflow()
        return self._observation(self.engine.now)

    def step(
        self, actions: Any
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, Infos]:
        """One policy step of every environment.

        Raises ValueError for actions of another shape, of no such number, or not finite, and
        ResetNeeded before the first reset; then no environment has moved. Throttle and steering
        outside their space are clipped, as highway-env does.
        """
        observation, rewards, terminated, truncated = self.advance(actions)
        return observation, rewards, terminated, truncated, self._said(np.array(actions))

    def advance(
        self, actions: Any
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray]:
        """``step`` without infos, for which see ``told``."""
        self._check_open()
        if not self.engine:
            actions = actions_of(actions, self.single_action_space, self.num_envs)
            *found, infos = self._envs.step(actions)
            self._infos = with_ids(infos, self.num_envs, self.set_spec.max_vehicles)
            return tuple(found)  # type: ignore[return-value]
        engine: Any = self._begun()
        over = engine.state.heads["over"] == ENDED
        if self.autoreset_mode is AutoresetMode.DISABLED and over.any():
            raise ValueError(
                f"environment {int(np.argmax(over))} has ended; reset it first: "
                "reset(options={'reset_mask': terminations | truncations})."
            )
        engine.step(actions)
        self._note_overflow()
        ends = engine.ends.copy()
        return (
            self._observation(engine.now), engine.rewards.copy(),
            ends[:, TERMINATED], ends[:, TRUNCATED],
        )  # fmt: skip

    def _said(self, taken: np.ndarray) -> Infos:
        """Infos of the last step, which took those actions."""
        engine = self.engine
        if not engine:
            return self._infos
        ended = engine.ends.any(axis=1)
        same_step = self.autoreset_mode is AutoresetMode.SAME_STEP
        reset = ended if same_step else engine.begun
        infos = infos_of(engine, engine.now, engine.everywhere, reset)
        if same_step:
            add_step(infos, engine, taken, ~ended)
            if ended.any():
                add_final(infos, engine, taken, ended)
        else:
            driven = ~engine.begun & (engine.state.heads["over"] != RESTING)
            add_step(infos, engine, taken, driven)
        return infos

    def told(
        self, chosen: np.ndarray, actions: np.ndarray | None = None
    ) -> Callable[[], list[Infos]]:
        """Says, when called, what some environments told last, each as ``gym.make`` does.

        actions: of all, in the step; None after a reset.
        """
        if not self.engine:
            return partial(rows, self._infos, chosen)
        said = told(self.engine.now, chosen)
        taken = None if actions is None else np.asarray(actions)[chosen]
        return partial(singly, self.engine.family, said, taken)

    @property
    def counts(self) -> np.ndarray:
        """M of every environment [num_envs]: the vehicles within the perception distance."""
        return self.engine.now.seen.counts[:, 0] if self.engine else self._infos["set"]["count"]

    def _observation(self, outputs: Any) -> dict[str, np.ndarray]:
        parts = outputs.seen.parts()
        return {name: part.copy() for name, part in parts.items()} if self.copy else parts

    def _note_overflow(self) -> None:
        """Say that vehicles were left out, as ``SetObservation`` does."""
        counts = self.engine.now.seen.counts
        if self._warned or not counts[:, 1].any():
            return
        count, n = int(counts[:, 0].max()), self.set_spec.max_vehicles
        self.engine.faulty = int(counts[:, 1].argmax())
        message = (
            f"{count} vehicles within {self.set_spec.perception_distance:g} m, but max_vehicles="
            f"{n}: the {n} nearest are kept. Raise max_vehicles to {count} or more to keep all; "
            "infos['set']['overflow'] counts those left out."
        )
        if self.set_spec.on_overflow == "error":
            raise OverflowError(message)
        warnings.warn(message, stacklevel=4)
        self._warned = True

    def measure(self, collisions: bool = False) -> Measured:
        """How the cars are driving now; with ``collisions`` their times to collision, too [s]."""
        self._check_open()
        if self.engine:
            return self._begun().measure(collisions)
        return measured(self._envs.envs, self._roads, collisions)

    @property
    def compute_reward(self) -> Any:
        """Parking's reward of goals [num_envs, 6]; AttributeError without ``goal=True``."""
        env = self.engine.env if self.engine else self._envs.envs[0]
        return env.get_wrapper_attr("compute_reward")

    def render(self) -> tuple[Any, ...] | None:
        """A frame of every environment."""
        if self.render_mode is None:
            return None
        if not self.engine:
            return self._envs.render()
        return tuple(self.materialise(index).render() for index in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        if self._envs:
            self._envs.close()
        if self.engine:
            self.engine.close()


def make_vec(base_id: str, num_envs: int = 1, **arguments: Any) -> SetVectorEnv:
    """Vector entry point of the ids."""
    return SetVectorEnv(base_id, num_envs, **arguments)
