"""Checkpoints from which training goes on as if nothing had happened, bit for bit.

A checkpoint is taken where a rollout begins. It holds the algorithm (weights, optimizers, replay
buffer, counters), every environment in mid-episode, and every random generator.

The file: one line of JSON, then a pickle. To unpickle is to run code, so the line also holds an
authentication code made with a key that only this user has: checkpoints of others need trust.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import pickle
from collections.abc import Sequence
from pathlib import Path
from threading import Thread
from typing import Any

import torch
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from esc_agents import files, strangers
from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.wrappers import generators, set_generators
from esc_agents.errors import UserError

SCHEMA = 1
SUFFIX = ".checkpoint"
KEEP = 2
# Belong to a process, not to the state of training.
_NOT_SAVED = {"env", "_vec_normalize_env", "_logger", "_custom_logger"}


class Damaged(Exception):
    """A checkpoint that is not what was written; says which and why."""


def capture(model: BaseAlgorithm, callbacks: Sequence[BaseCallback]) -> bytes:
    """The whole state of training, pickled."""
    envs: Any = model.env
    return pickle.dumps(
        {
            "model": {k: v for k, v in vars(model).items() if k not in _NOT_SAVED},
            # What was logged since the last row of metrics.
            "logged": [model.logger.name_to_value, model.logger.name_to_count,
                       model.logger.name_to_excluded],
            "callbacks": [getattr(callback, "state", None) for callback in callbacks],
            "envs": envs.state() if isinstance(envs, BatchVecEnv) else envs.env_method("state"),
            "random": _generators(),
        },
        pickle.HIGHEST_PROTOCOL,
    )  # fmt: skip


def restore(
    state: bytes, algorithm: type[BaseAlgorithm], envs: VecEnv
) -> tuple[BaseAlgorithm, dict[str, Any]]:
    """(model with ``envs``, what ``resume`` has still to hand out) from a captured state."""
    found = pickle.loads(state)
    model = algorithm.__new__(algorithm)
    vars(model).update(found["model"], _custom_logger=False, _vec_normalize_env=None)
    model.set_env(envs, force_reset=False)
    if isinstance(replay := getattr(model, "replay_buffer", None), HerReplayBuffer):
        replay.set_env(envs)
    _restore_environments(envs, found["envs"])
    return model, found


def _restore_environments(envs: Any, state: Any) -> None:
    """state: bytes of a batch, or of each environment.

    Raises UserError where it is of the other kind.
    """
    if isinstance(envs, BatchVecEnv) != isinstance(state, bytes):
        where = "in the batch engine" if isinstance(state, bytes) else "as objects"
        raise UserError(
            f"the environments of this checkpoint were simulated {where}, which they are not here; "
            "continue it with the versions that wrote it"
        )
    if isinstance(state, bytes):
        envs.restore(state)
        return
    for index, env in enumerate(state):
        envs.env_method("restore", env, indices=index)


def resume(model: BaseAlgorithm, found: dict[str, Any], callbacks: Sequence[BaseCallback]) -> None:
    """Hand out the rest of a restored state: last, since everything before may draw numbers."""
    logger = model.logger
    logger.name_to_value, logger.name_to_count, logger.name_to_excluded = found["logged"]
    for callback, state in zip(callbacks, found["callbacks"], strict=True):
        if state is not None:
            callback.state = state  # type: ignore[attr-defined]
    _set_generators(found["random"])


def _generators() -> dict[str, Any]:
    found: dict[str, Any] = {"process": generators(), "torch": torch.get_rng_state()}
    return found | ({"cuda": torch.cuda.get_rng_state_all()} if torch.cuda.is_available() else {})


def _set_generators(found: dict[str, Any]) -> None:
    set_generators(found["process"])
    torch.set_rng_state(found["torch"])
    if "cuda" in found and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(found["cuda"])


def sha256(state: bytes) -> str:
    return hashlib.sha256(state).hexdigest()


def path_of(folder: Path, steps: int) -> Path:
    """<steps, 12 digits>.checkpoint"""
    return folder / f"{steps:012d}{SUFFIX}"


def write(folder: Path, steps: int, state: bytes) -> Path:
    """Write a checkpoint at once: it is there whole, or not at all; older ones go but for one."""
    header = {
        "schema": SCHEMA, "steps": steps, "size": len(state),
        "sha256": sha256(state),
        "mac": strangers.sign(state).hex(), "versions": files.versions(),
    }  # fmt: skip
    path = path_of(folder, steps)

    def fill(file: Any) -> None:
        file.write(json.dumps(header).encode() + b"\n")
        file.write(state)

    files.write_atomically(path, fill)
    thin_out(folder)
    return path


def thin_out(folder: Path) -> None:
    """Remove all checkpoints but the newest two."""
    for old in in_order(folder)[:-KEEP]:
        old.unlink(missing_ok=True)


def in_order(folder: Path) -> list[Path]:
    """The checkpoints of a folder, the oldest first."""
    return sorted(folder.glob(f"*{SUFFIX}"))


def read(path: Path, trust: bool = False) -> bytes:
    """The state in a checkpoint file, not yet unpickled.

    Raises Damaged, or UserError where it is another version's, or somebody else's and not trusted.
    """
    try:
        with path.open("rb") as file:
            header = json.loads(file.readline(100_000))
            state = file.read()
        schema, size, digest, mac = (header[k] for k in ("schema", "size", "sha256", "mac"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise Damaged(f"{path} is no whole checkpoint ({type(error).__name__})") from error
    if schema != SCHEMA:
        raise UserError(
            f"{path}: expected a checkpoint of schema {SCHEMA}, got {schema!r}; continue it with "
            f"the version that wrote it (esc-gym {_version(header)})"
        )
    if len(state) != size:
        raise Damaged(f"{path} is cut off: expected {size!r} bytes, got {len(state)}")
    if sha256(state) != digest:
        raise Damaged(f"{path} is damaged: its contents do not match their checksum")
    ours = strangers.sign(state).hex()
    if not trust and not hmac.compare_digest(ours.encode(), str(mac).encode(errors="replace")):
        raise UserError(
            f"{path} was not written by you on this machine, and to load it can run code of "
            "whoever wrote it; add --trust if you trust them"
        )
    return state


def _version(header: Any) -> str:
    found = header.get("versions")
    return str(found.get("esc-gym")) if isinstance(found, dict) else "unknown"


class Writer:
    """Writes checkpoints beside training. One at a time; an error is said, and training goes on."""

    def __init__(self, folder: Path, say: Any) -> None:
        self.folder, self.say = folder, say
        self._thread: Thread | None = None

    def write(self, steps: int, state: bytes) -> None:
        self.wait()
        self._thread = Thread(target=self._write, args=(steps, state))
        self._thread.start()

    def wait(self) -> None:
        """Until what was begun is on the disk."""
        if self._thread:
            self._thread.join()
            self._thread = None

    def _write(self, steps: int, state: bytes) -> None:
        try:
            write(self.folder, steps, state)
        except (OSError, UserError) as error:
            reason = getattr(error, "strerror", None) or error
            left = in_order(self.folder)
            before = f"that of step {int(left[-1].stem):,} stands" if left else "there is none yet"
            self.say(f"checkpoint at step {steps:,} could not be written ({reason}); {before}")
