"""The whole state of a batch in hand: to keep, to go back to, to copy, to look at."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from copy import copy as shallow_copy
from typing import Any, Self

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv

from esc_gym.fastsim.records import VEHICLE
from esc_gym.vector.arguments import index_of, indices_of, mask_of
from esc_gym.vector.engine import Engine
from esc_gym.vector.infos import Infos, infos_of
from esc_gym.vector.kernel import NOTHING
from esc_gym.vector.objects import materialise, reset_quietly
from esc_gym.vector.state import HEAD, RESTING, UNBORN, packed, unpack


class StateInHand(VectorEnv):
    """What ``SetVectorEnv`` does with its state; see there."""

    engine: Any
    set_spec: Any
    autoreset_mode: Any
    _envs: Any
    _reason: str
    _limit: int
    _task: Any
    _make_one: Callable[..., gym.Env]
    _observation: Callable[[Any], dict[str, np.ndarray]]

    def rest(self, mask: np.ndarray) -> None:
        """Leave alone, from now on, the environments of ``mask`` (bool [num_envs]).

        Until they are reset, a step gives their last observation again, reward 0 and no end.
        Raises ValueError where the engine does not simulate this (``report()``).
        """
        self._begun().state.heads["over"][mask_of(mask, self.num_envs, "mask")] = RESTING

    def snapshot(self) -> bytes:
        """Everything that the future of all environments depends on, and what was returned last.

        Raises ValueError where the engine does not simulate this (``report()``).
        """
        return packed(self._begun().arrays(), self._identity())

    def restore(self, snapshot: bytes) -> tuple[dict[str, np.ndarray], Infos]:
        """Go on where ``snapshot`` was taken; observations and infos are those of that time.

        Raises ValueError, and changes nothing, for a snapshot that is damaged, of another version,
        or of other environments.
        """
        engine = self._known()
        unpack(snapshot, engine.arrays(), self._identity())
        engine.watching = NOTHING
        begun = engine.state.heads["elapsed"] == 0
        infos = infos_of(engine, engine.now, engine.everywhere, begun)
        return self._observation(engine.now), infos

    def fork(self, indices: Sequence[int]) -> Self:
        """A new batch of copies of some environments, as many times as asked for.

        indices: numbers of environments, from the end if negative. What these were last told is the
        copies', too, and they go on as the originals would. Raises ValueError where the engine does
        not simulate this (``report()``).
        """
        chosen = indices_of(indices, self.num_envs)
        other = shallow_copy(self)
        other.__dict__.pop("observation_space", None)
        other.__dict__.pop("action_space", None)
        other.num_envs, other.engine = len(chosen), self._begun().fork(chosen)
        return other

    def keep(self, indices: Sequence[int]) -> tuple[np.ndarray, ...]:
        """The states of some environments, for ``go_back``: arrays with a row for each.

        indices: as for ``fork``. Raises ValueError where the engine does not simulate this.
        """
        chosen = indices_of(indices, self.num_envs)
        return tuple(array.take(chosen, axis=0) for array in self._begun().arrays())

    def go_back(self, indices: Sequence[int], kept: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Let some environments go on from states that ``keep`` gave; observations of all.

        indices: as for ``fork``, but each once; kept: a row for each, of whichever environments of
        this batch, or of another one of the same id and configuration. Each keeps its own random
        generator, so that the same state can go on in many ways. Raises ValueError, and changes
        nothing, for states of another shape, of which no more is checked.
        """
        chosen = indices_of(indices, self.num_envs)
        if len(set(chosen.tolist())) < len(chosen):
            raise ValueError(f"indices: expected each environment once, got {chosen.tolist()}")
        engine = self._begun()
        wanted = [((len(chosen), *array.shape[1:]), array.dtype) for array in engine.arrays()]
        arrays = isinstance(kept, tuple | list) and all(isinstance(a, np.ndarray) for a in kept)
        if not arrays or [(array.shape, array.dtype) for array in kept] != wanted:
            raise ValueError(
                f"kept: expected what keep() gives of {len(chosen)} environments like these, of the"
                " same id and configuration"
            )
        engine.go_back(chosen, kept)
        return self._observation(engine.now)

    def _check_open(self) -> None:
        if self.closed:
            raise gym.error.ClosedEnvironmentError("this batch was closed; make another")

    def _known(self) -> Engine:
        self._check_open()
        if self.engine is None:
            raise ValueError(
                "snapshot, restore, fork, keep, go_back and rest need the batch engine, which does "
                f"not simulate this: {self._reason}"
            )
        return self.engine

    def _begun(self) -> Engine:
        """The engine, once all its environments have been reset."""
        engine = self._known()
        if not engine.born:
            unborn = engine.state.heads["over"] == UNBORN
            if unborn.any():
                raise gym.error.ResetNeeded(
                    f"environment {int(np.argmax(unborn))} was never reset: call reset() first"
                )
            engine.born = True
        return engine

    def _identity(self) -> dict[str, object]:
        base_id, config = self._task
        return {
            "id": base_id, "config": config, "num_envs": self.num_envs,
            "observation": (self.set_spec, self.set_spec.limits),
            "autoreset_mode": self.autoreset_mode, "max_episode_steps": self._limit,
            "version of esc_gym": (VEHICLE, HEAD),
        }  # fmt: skip

    def materialise(self, index: int) -> gym.Env:
        """A ``gym.make`` environment in exactly the state of environment ``index``.

        index: from the end if negative.

        For rendering, debugging and films; stepping it changes nothing here. What a LinearVehicle
        has collected to fit its parameters to, which no step reads, it does not have. Of an episode
        that has ended it is the end: a reset that the next step of the batch would make is yours.
        """
        self._check_open()
        if not self.engine:
            return pickle.loads(pickle.dumps(self._envs.envs[index_of(index, self.num_envs)]))
        state: Any = self._begun().state
        env = self._make_one("rgb_array")
        reset_quietly(env)
        materialise(env, state, index_of(index, self.num_envs))
        if self._limit:
            env._elapsed_steps = int(state.heads["elapsed"][index])  # type: ignore[attr-defined]
        return env
