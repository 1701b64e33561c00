"""The ``info`` of a batch: arrays, and beside each a mask ``_name`` of those it is of."""

from __future__ import annotations

from typing import Any

import numpy as np

Infos = dict[str, Any]
# Of these, highway-env's info of a reset has those of an action that it drew to fill it.
OF_ACTIONS = {"lane_change_reward", "action_reward"}


def masked(values: dict[str, Any], mask: np.ndarray) -> Infos:
    """``values`` with a mask ``_name`` beside each; where it is False, nothing, as in Gymnasium."""
    infos: Infos = {}
    for name, value in values.items():
        if isinstance(value, dict):
            value = masked(value, mask)
        elif not mask.all():
            value = value.copy()
            value[~mask] = None if value.dtype == object else -1 if name == "ids" else 0
        infos[name], infos[f"_{name}"] = value, mask.copy()
    return infos


def told(outputs: Any, chosen: Any) -> tuple[np.ndarray, ...]:
    """Copies of what infos of some environments are made of."""
    seen, said = outputs.seen, outputs.told
    return tuple(
        a.take(chosen, axis=0)
        for a in (seen.counts, seen.ids, said.speed, said.crashed, said.rewards)
    )


def columns_of(family: Any, said: tuple[np.ndarray, ...]) -> dict[str, Any]:
    """``told`` by name, of environments that say all of it."""
    counts, ids, speed, crashed, rewards = said
    names, extras = family.REWARDS, getattr(family, "EXTRAS", {})
    columns = {
        name: column.astype(kind)
        for (name, kind), column in zip((names | extras).items(), rewards.T, strict=True)
    }
    found: dict[str, Any] = {
        "set": {"count": counts[:, 0], "overflow": counts[:, 1], "ids": ids},
        "speed": speed,
        "crashed": crashed,
    }
    if names:
        found["rewards"] = {name: columns[name] for name in names}
    for name in extras:  # one agent in each
        found[name] = columns[name][:, None] if name.startswith("agents_") else columns[name]
    return found


def infos_of(engine: Any, outputs: Any, mask: np.ndarray, reset: np.ndarray | None = None) -> Infos:
    """What the environments of ``mask`` say of ``outputs``, those of ``reset`` after a reset.

    By default all are. After a step families that are SILENT say less, the others more.
    """
    reset = mask if reset is None else reset
    found = columns_of(engine.family, told(outputs, np.arange(len(mask))))
    infos = masked({"set": found.pop("set")}, mask)
    speaking = reset if hasattr(engine.family, "SILENT") else mask
    if not speaking.any():
        return infos
    infos |= masked(found, speaking)
    driven, rewards = mask & ~reset, infos.get("rewards", {})
    for name in OF_ACTIONS & rewards.keys():
        earned = {name: rewards.pop(name)}
        del rewards[f"_{name}"]
        rewards |= masked(earned, driven) if driven.any() else {}
    return infos


def of_step(family: Any, infos: Infos, actions: np.ndarray) -> Infos:
    """What there is only after a step. infos: what else is said of it."""
    found: Infos = {"action": actions}
    if name := getattr(family, "SUCCESS", None):
        found["is_success"] = infos["rewards"][name]
    return found


def add_step(infos: Infos, engine: Any, actions: np.ndarray, mask: np.ndarray) -> None:
    """Add what there is only after a step."""
    if mask.any() and not hasattr(engine.family, "SILENT"):
        infos.update(masked(of_step(engine.family, infos, actions), mask))


def add_final(infos: Infos, engine: Any, actions: np.ndarray, ended: np.ndarray) -> None:
    """What the last step of those episodes gave that have ended and begun anew."""
    observations = np.full(len(ended), None, object)
    parts = engine.final.seen.parts()
    for e in np.flatnonzero(ended):
        observations[e] = {name: part[e].copy() for name, part in parts.items()}
    last = infos_of(engine, engine.final, ended, ~engine.everywhere)
    add_step(last, engine, actions, ended)
    infos.update(masked({"final_obs": observations}, ended))
    infos.update({"final_info": last, "_final_info": ended.copy()})


def singly(family: Any, said: tuple[np.ndarray, ...], actions: Any) -> list[Infos]:
    """``told`` as infos of ``gym.make``. actions: of the step, None of a reset."""
    found = columns_of(family, said)
    if actions is not None:
        silent = hasattr(family, "SILENT")
        found = {"set": found["set"]} if silent else found | of_step(family, found, actions)
    elif "rewards" in found:
        rewards = found["rewards"]
        found["rewards"] = {name: rewards[name] for name in rewards if name not in OF_ACTIONS}
    return [_without_padding(info) for info in _split(found)]


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
