"""The ``info`` of a batch: arrays, and beside each a mask ``_name`` of those it is of."""

from __future__ import annotations

from typing import Any

import numpy as np

Infos = dict[str, Any]


def masked(values: dict[str, Any], mask: np.ndarray) -> Infos:
    """``values`` with a mask ``_name`` beside each."""
    infos: Infos = {}
    for name, value in values.items():
        infos[name] = masked(value, mask) if isinstance(value, dict) else value
        infos[f"_{name}"] = mask.copy()
    return infos


def columns_of(engine: Any, outputs: Any, chosen: Any) -> dict[str, Any]:
    """What some environments say of ``outputs``, of all of which they say it; copies."""
    told, seen, family = outputs.told, outputs.seen, engine.family
    counts, names, extras = seen.counts[chosen], family.REWARDS, getattr(family, "EXTRAS", {})
    columns = {
        name: column.astype(kind)
        for (name, kind), column in zip(
            (names | extras).items(), told.rewards[chosen].T, strict=True
        )
    }
    found: dict[str, Any] = {
        "set": {
            "count": counts[:, 0].copy(),
            "overflow": counts[:, 1].copy(),
            "ids": seen.ids[chosen].copy(),
        },
        "speed": told.speed[chosen].copy(),
        "crashed": told.crashed[chosen].copy(),
    }
    if names:
        found["rewards"] = {name: columns[name] for name in names}
    for name in extras:  # one agent in each
        found[name] = columns[name][:, None] if name.startswith("agents_") else columns[name]
    return found


def infos_of(engine: Any, outputs: Any, mask: np.ndarray, reset: np.ndarray | None = None) -> Infos:
    """What the environments of ``mask`` say of ``outputs``, those of ``reset`` after a reset.

    By default all are: only families that are SILENT say less after a step.
    """
    found = columns_of(engine, outputs, slice(None))
    infos = masked({"set": found.pop("set")}, mask)
    speaking = mask if reset is None or not hasattr(engine.family, "SILENT") else reset
    return infos | masked(found, speaking) if speaking.any() else infos


def of_step(engine: Any, infos: Infos, actions: np.ndarray) -> Infos:
    """What there is only after a step. infos: what else is said of it."""
    found: Infos = {"action": actions}
    if name := getattr(engine.family, "SUCCESS", None):
        found["is_success"] = infos["rewards"][name]
    return found


def add_step(infos: Infos, engine: Any, actions: np.ndarray, mask: np.ndarray) -> None:
    """Add what there is only after a step."""
    if mask.any() and not hasattr(engine.family, "SILENT"):
        infos.update(masked(of_step(engine, infos, actions), mask))


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


def columns_of_step(engine: Any, chosen: np.ndarray, actions: Any) -> dict[str, Any]:
    """What some environments said last. actions: of the step, None of a reset."""
    found = columns_of(engine, engine.now, chosen)
    if actions is None:
        return found
    if hasattr(engine.family, "SILENT"):
        return {"set": found["set"]}
    return found | of_step(engine, found, np.asarray(actions)[chosen])


def singly(columns: dict[str, Any]) -> list[Infos]:
    """Infos as ``gym.make`` gives them, of each environment of ``columns_of``."""
    return [_without_padding(info) for info in _split(columns)]


def _split(columns: dict[str, Any]) -> list[Infos]:
    parts = [_split(part) if isinstance(part, dict) else list(part) for part in columns.values()]
    return [dict(zip(columns, values, strict=True)) for values in zip(*parts, strict=True)]


def _without_padding(info: Infos) -> Infos:
    """``info`` with the ids of the real rows only."""
    if "set" in info:
        part = info["set"]
        part["ids"] = tuple(part["ids"][: part["count"] - part["overflow"]].tolist())
    return info


def rows(infos: Infos, chosen: Any) -> list[Infos]:
    """What some environments say: infos as ``gym.make`` gives them, ids without their padding."""
    found: list[Infos] = [{} for _ in chosen]
    for name, values in infos.items():
        if name.startswith("_"):
            continue
        parts = rows(values, chosen) if isinstance(values, dict) else [values[e] for e in chosen]
        for info, part, said in zip(found, parts, infos[f"_{name}"][chosen].tolist(), strict=True):
            if said:
                info[name] = part
    return [_without_padding(info) for info in found]


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
