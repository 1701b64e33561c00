"""Compiled code on disk: found again, compiled once by processes that start together."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from esc_gym.fastsim import cache

START = """
import gymnasium as gym, esc_gym
env = gym.make("esc_gym/merge-v0")
env.reset(seed=0)
env.step(1)
print(esc_gym.fastsim.report(env).compiled, env.unwrapped.vehicle.position.tolist())
"""
MESSAGE = "esc_gym: compiling the simulation"


def start(directory):
    arguments = [sys.executable, "-W", "ignore", "-c", START]
    environment = {**os.environ, "ESC_GYM_CACHE_DIR": str(directory)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(arguments, env=environment, text=True, **pipes)


@pytest.mark.slow
def test_processes_that_start_together_compile_once(tmp_path):
    processes = [start(tmp_path), start(tmp_path)]
    outputs = [process.communicate() for process in processes]
    outputs.append(start(tmp_path).communicate())
    assert {out for out, _ in outputs} == {outputs[0][0]}
    assert outputs[0][0].startswith("1 [")
    assert sum(errors.count(MESSAGE) for _, errors in outputs) == 1
    assert MESSAGE not in outputs[-1][1]


def double(x):
    return 2 * x


@pytest.fixture
def directory(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "cache_directory", lambda: tmp_path)
    return tmp_path


def files(directory: Path, pattern: str) -> list[Path]:
    return [path for path in directory.rglob(pattern) if path.is_file()]


def test_the_first_process_says_what_it_does(directory, capsys):
    assert cache.warm(lambda: cache.cached(double)(4)) == 8
    assert str(directory) in capsys.readouterr().err
    again = cache.cached(double)
    assert cache.warm(lambda: again(5)) == 10
    assert capsys.readouterr().err == ""
    assert sum(again.stats.cache_hits.values()) == 1


@pytest.mark.parametrize("pattern", ["*.nbi", "*.nbc"])
def test_damaged_files_are_replaced(directory, pattern, capsys):
    cache.warm(lambda: cache.cached(double)(4))
    (damaged,) = files(directory, pattern)
    damaged.write_bytes(damaged.read_bytes()[:50])
    assert cache.warm(lambda: cache.cached(double)(4)) == 8
    again = cache.cached(double)
    assert again(4) == 8
    assert sum(again.stats.cache_hits.values()) == 1


def test_nothing_can_be_written(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "file" / "below"))
    monkeypatch.setattr(cache, "cache_directory", cache.cache_directory.__wrapped__)
    assert cache.cache_directory() is None
    assert cache.warm(lambda: cache.cached(double)(4)) == 8
    assert "kept by this process only" in capsys.readouterr().err


def test_a_read_only_home(tmp_path, monkeypatch):
    """Then it is a temporary directory that nobody else can write to."""
    (tmp_path / "file").write_text("")
    monkeypatch.delenv(cache.VARIABLE, raising=False)
    monkeypatch.setattr(cache, "user_cache_path", lambda name: tmp_path / "file" / name)
    monkeypatch.setattr(cache.tempfile, "gettempdir", lambda: str(tmp_path))
    found = cache.cache_directory.__wrapped__()
    assert found.is_relative_to(tmp_path)
    assert found.stat().st_mode & 0o077 == 0


def test_somebody_elses_directory_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path))
    assert cache.cache_directory.__wrapped__() is not None
    monkeypatch.setattr(cache.os, "getuid", lambda: os.stat(tmp_path).st_uid + 1)
    assert cache.cache_directory.__wrapped__() is None
