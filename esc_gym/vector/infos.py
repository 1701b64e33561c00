"""The ``info`` of a batch: arrays, and beside each a mask ``_name`` of those it is of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

Infos = dict[str, Any]


def masked(values: dict[str, Any], mask: np.ndarray) -> Infos:
    """``values`` with a mask ``_name`` beside each."""
    return {
        key: part for name, value in values.items()
        for key, part in ((name, value), (f"_{name}", mask.copy()))
    }  # fmt: skip


def infos_of(engine: Any, outputs: Any, mask: np.ndarray, reset: np.ndarray | None = None) -> Infos:
    """What the environments of ``mask`` say of ``outputs``, those of ``reset`` after a reset.

    By default all are: only families that are SILENT say less after a step.
    """
    told, seen = outputs.told, outputs.seen
    family = engine.family
    speaking = mask if reset is None or not hasattr(family, "SILENT") else reset
    perceived = {
        "count": seen.counts[:, 0].copy(),
        "overflow": seen.counts[:, 1].copy(),
        "ids": seen.ids.copy(),
    }
    infos = masked({"set": masked(perceived, mask)}, mask)
    if speaking.any():
        parts = {"speed": told.speed.copy(), "crashed": told.crashed.copy()}
        names, extras = family.REWARDS, getattr(family, "EXTRAS", {})
        columns = {
            name: column.astype(kind)
            for (name, kind), column in zip((names | extras).items(), told.rewards.T, strict=True)
        }
        if names:
            parts["rewards"] = masked({name: columns[name] for name in names}, speaking)
        for name in extras:  # one agent in each
            parts[name] = columns[name][:, None] if name.startswith("agents_") else columns[name]
        infos |= masked(parts, speaking)
    return infos


def add_step(infos: Infos, engine: Any, actions: np.ndarray, mask: np.ndarray) -> None:
    """What there is only after a step."""
    if mask.any() and not hasattr(engine.family, "SILENT"):
        found: dict[str, Any] = {"action": actions}
        if name := getattr(engine.family, "SUCCESS", None):
            found["is_success"] = infos["rewards"][name]
        infos.update(masked(found, mask))


def add_final(infos: Infos, engine: Any, actions: np.ndarray, ended: np.ndarray) -> None:
    """What the last step of those episodes gave that have ended and begun anew."""
    observations = np.full(len(ended), None, object)
    ego, vehicles, mask, *_ = engine.final.seen
    for e in np.flatnonzero(ended):
        parts = {"ego": ego[e], "vehicles": vehicles[e], "mask": mask[e]}
        observations[e] = {name: part.copy() for name, part in parts.items()}
    last = infos_of(engine, engine.final, ended, ~engine.everywhere)
    add_step(last, engine, actions, ended)
    infos.update(masked({"final_obs": observations, "final_info": last}, ended))


def rows(infos: Infos, chosen: Sequence[int]) -> list[Infos]:
    """What some environments say: infos as ``gym.make`` gives them, ids without their padding."""
    found: list[Infos] = [{} for _ in chosen]
    for name, values in infos.items():
        if name.startswith("_"):
            continue
        parts = rows(values, chosen) if isinstance(values, dict) else [values[e] for e in chosen]
        for info, part, said in zip(found, parts, infos[f"_{name}"][chosen].tolist(), strict=True):
            if said:
                info[name] = part
    for info in found:
        if "set" in info:
            part = info["set"]
            part["ids"] = tuple(part["ids"][: part["count"] - part["overflow"]].tolist())
    return found


def with_ids(infos: Infos, count: int, n: int) -> Infos:
    """Gymnasium's infos of ``count`` environments, with ids [count, n] as of ``infos_of``."""
    for part in (infos, infos.get("final_info", {})):
        for name in ("agents_rewards", "agents_terminated"):
            if name in part:
                part[name] = np.array([[0.0] if x is None else list(x) for x in part[name]])
        if "set" in part:
            rows, ids = part["set"]["ids"], np.full((count, n), -1)
            for e in np.flatnonzero(part["set"]["_ids"]):
                ids[e, : len(rows[e])] = rows[e]
            part["set"]["ids"] = ids
    return infos
