"""Traffic behaviour per environment, although highway-env keeps it in class attributes.

``IntersectionEnv._make_vehicles`` writes three attributes of its vehicle class, for the whole
process: every highway made afterwards drives differently with the same seed. Here a reset runs on
highway-env's original values, the vehicles it made get the values it ended with as attributes of
their own, and the process gets back what it had.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from types import ModuleType
from typing import Any

from highway_env.vehicle import behavior
from highway_env.vehicle.behavior import IDMVehicle

PARAMETERS = ("DISTANCE_WANTED", "COMFORT_ACC_MAX", "COMFORT_ACC_MIN")


@cache
def _original_module() -> ModuleType:
    """A second, untouched execution of ``highway_env.vehicle.behavior``."""
    spec = importlib.util.find_spec(behavior.__name__)
    module = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
    spec.loader.exec_module(module)  # type: ignore[union-attr]
    return module


@cache
def _original_parameters(cls: type[IDMVehicle]) -> dict[str, float]:
    """The parameters that the source of ``cls`` itself sets; of a user's class, on first sight."""
    if cls.__module__ == behavior.__name__:
        cls = getattr(_original_module(), cls.__name__)
    return {name: vars(cls)[name] for name in PARAMETERS if name in vars(cls)}


def _write(cls: type[IDMVehicle], parameters: dict[str, float]) -> None:
    for name in PARAMETERS:
        if name in parameters:
            setattr(cls, name, parameters[name])
        elif name in vars(cls):
            delattr(cls, name)


@contextmanager
def original_behavior(vehicle_type: Any) -> Iterator[None]:
    """Inside, ``vehicle_type`` and ``IDMVehicle`` have the parameters of a fresh process."""
    lineage = {*vehicle_type.__mro__, IDMVehicle}
    classes = [cls for cls in lineage if issubclass(cls, IDMVehicle)]
    # Originals first: what a user's class holds now is remembered before anything is written.
    originals = {cls: _original_parameters(cls) for cls in classes}
    found = {cls: {n: vars(cls)[n] for n in PARAMETERS if n in vars(cls)} for cls in classes}
    try:
        for cls in classes:
            _write(cls, originals[cls])
        yield
    finally:
        for cls in classes:
            _write(cls, found[cls])


class Behavior:
    """The parameters of one environment's traffic, by vehicle class."""

    def __init__(self) -> None:
        self._parameters: dict[type, dict[str, float]] = {}

    def learn(self, vehicle_types: Iterable[type]) -> None:
        """Take the classes' present parameters as this environment's (inside the context above)."""
        self._parameters = {
            cls: {name: getattr(cls, name) for name in PARAMETERS}
            for cls in vehicle_types
            if issubclass(cls, IDMVehicle)
        }

    def pin(self, vehicles: list[Any]) -> None:
        """Give vehicles their parameters as own attributes; the newest are last, so stop early."""
        for vehicle in reversed(vehicles):
            if "DISTANCE_WANTED" in vars(vehicle):
                return
            if parameters := self._parameters.get(type(vehicle)):
                vars(vehicle).update(parameters)
