"""Where compiled kernels are kept between processes.

One directory per content: the kernels' source, the versions of what compiles them, and the
processor. Numba itself only looks at the file that the entry function is in.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding
import numba
import numpy as np
from platformdirs import user_cache_path

# Filled when Numba is imported.
_settings: Any = import_module("numba.core.config")
VARIABLE = "ESC_GYM_CACHE_DIR"
# Files of the package that hold compiled code, or what it is compiled from.
_COMPILED = (
    "features.py", "fastsim/*.py", "vector/scenes/*.py",
    *(f"vector/{name}.py"
      for name in ("columns", "generators", "kernel", "measures", "observe", "state")),
)  # fmt: skip
# Without the interpreter's lock, so that threads share environments out among them.
_OPTIONS: Any = {"error_model": "numpy", "nogil": True}


@cache
def cache_directory() -> Path | None:
    """A directory of our own that can be written to, or None: then every process compiles."""
    name = f"kernels-{_fingerprint()}"
    for base in _candidates():
        directory = base / name
        with suppress(OSError):
            directory.mkdir(mode=0o700, parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=directory):
                pass
            # What is loaded from here is code: it has to be ours, in a shared /tmp above all.
            if not hasattr(os, "getuid") or directory.stat().st_uid == os.getuid():
                return directory
    return None


def _candidates() -> Iterator[Path]:
    if chosen := os.environ.get(VARIABLE):
        yield Path(chosen)
        return
    if _settings.CACHE_DIR:
        yield Path(_settings.CACHE_DIR) / "esc_gym"
    with suppress(RuntimeError):  # no home directory
        yield user_cache_path("esc_gym")
    user = os.getuid() if hasattr(os, "getuid") else ""
    yield Path(tempfile.gettempdir()) / f"esc_gym-{user}"


def _fingerprint() -> str:
    digest = hashlib.sha256()
    package = Path(__file__).parent.parent
    for source in sorted(path for pattern in _COMPILED for path in package.glob(pattern)):
        digest.update(source.read_bytes())
    versions = (platform.python_version(), numba.__version__, llvmlite.__version__, np.__version__)
    cpu = llvmlite.binding.get_host_cpu_name(), llvmlite.binding.get_host_cpu_features().flatten()
    digest.update(repr((*versions, *cpu)).encode())
    return digest.hexdigest()[:16]


def cached(function: Callable[..., Any]) -> Any:
    """Compile ``function`` on its first call, or take it from ``cache_directory``."""
    directory = cache_directory()
    if directory is None:
        return numba.njit(function, **_OPTIONS)
    before, _settings.CACHE_DIR = _settings.CACHE_DIR, str(directory)
    try:
        return numba.njit(function, cache=True, **_OPTIONS)
    finally:
        _settings.CACHE_DIR = before


def warm(first_calls: Callable[[], Any]) -> Any:
    """Make the first calls of cached functions: one process compiles, the others wait and load."""
    directory = cache_directory()
    with _locked(directory):
        if directory is None or not any(directory.rglob("*.nbi")):
            place = f"kept in {directory}" if directory else "kept by this process only"
            sys.stderr.write(f"esc_gym: compiling the simulation, about a minute, {place}\n")
        try:
            return first_calls()
        except Exception:
            if directory is None:
                raise
            # Damaged files, of a full disk say: Numba does not look at what it unpickles.
            for damaged in directory.iterdir():
                if damaged.is_dir():
                    shutil.rmtree(damaged, ignore_errors=True)
            return first_calls()


@contextmanager
def _locked(directory: Path | None) -> Iterator[None]:
    try:
        import fcntl
    except ImportError:  # Windows: processes that start together may each compile
        fcntl = None
    if directory is None or fcntl is None:
        yield
        return
    with open(directory / "lock", "w") as lock:
        with suppress(OSError):  # some network file systems cannot
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield
