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
_NAMES = set(PARAMETERS)


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
    return _present_parameters(cls)


def _present_parameters(cls: type[IDMVehicle]) -> dict[str, float]:
    return {name: vars(cls)[name] for name in PARAMETERS if name in vars(cls)}


def _lineage(vehicle_type: type) -> list[type[IDMVehicle]]:
    """The class and its ancestors from IDMVehicle down, the class first."""
    return [cls for cls in vehicle_type.__mro__ if issubclass(cls, IDMVehicle)]


def _write(cls: type[IDMVehicle], parameters: dict[str, float]) -> None:
    for name in PARAMETERS:
        if name in parameters:
            setattr(cls, name, parameters[name])
        elif name in vars(cls):
            delattr(cls, name)


@contextmanager
def original_behavior(vehicle_type: Any) -> Iterator[None]:
    """Inside, ``vehicle_type`` and ``IDMVehicle`` have the parameters of a fresh process."""
    classes = {*_lineage(vehicle_type), IDMVehicle}
    # Originals first: what a user's class holds now is remembered before anything is written.
    originals = {cls: _original_parameters(cls) for cls in classes}
    found = {cls: _present_parameters(cls) for cls in classes}
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
        self._own: dict[type, dict[str, float]] = {}

    def learn(self, vehicle_types: Iterable[type]) -> None:
        """Take the classes' present parameters as this environment's (inside the context above)."""
        classes = {cls for vehicle_type in vehicle_types for cls in _lineage(vehicle_type)}
        self._own = {cls: _present_parameters(cls) for cls in classes}

    def _of(self, vehicle_type: type) -> dict[str, float]:
        """What a vehicle of that class would inherit; {} for one that is no IDM vehicle."""
        parameters = {}
        for cls in reversed(_lineage(vehicle_type)):
            parameters |= self._own[cls] if cls in self._own else _original_parameters(cls)
        return parameters

    def pin(self, vehicles: list[Any]) -> None:
        """Give vehicles that have none their parameters as own attributes."""
        for vehicle in vehicles:
            own = vehicle.__dict__
            if not own.keys() >= _NAMES:
                own.update({**self._of(type(vehicle)), **own})
