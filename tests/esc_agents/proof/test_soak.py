"""The soak, short: every scenario, and that a fault is counted."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from esc_agents.cli.soak import command
from esc_agents.driving.batch import BatchVecEnv
from esc_agents.proof import soak
from esc_agents.proof.soak import cases
from tests.esc_agents.tiny import tiny

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="measures memory as Linux does")


@pytest.mark.slow
def test_every_scenario_with_all_its_actions(tmp_path, capsys):
    out = tmp_path / "docs" / "reliability.md"
    count = len(cases())
    assert command(["--steps", str(128 * count), "--out", str(out)]) == 0
    text = out.read_text()
    assert f"{128 * count:,} steps" in text
    assert text.count("| 128 |") == count
    assert {name for name, _ in cases()} <= set(text.replace("|", " ").split())
    assert capsys.readouterr().out.endswith("in one process.\n")


def test_faults_are_counted_and_named(monkeypatch):
    def broken(self, action):
        raise ZeroDivisionError("a custom road")

    monkeypatch.setattr("esc_gym.observation.SetObservation.step", broken)
    monkeypatch.setattr(soak, "ENVIRONMENTS", 2)
    result = soak.soak("highway-fast", tiny(), 3, 0)
    assert result.faults == ["episode 0, step 1: ZeroDivisionError: a custom road"] * 4
    assert (result.steps, result.episodes) == (4, 0)
    assert "ZeroDivisionError: a custom road" in soak.text([result], 3, 0, Path("soak.md"))


def test_observations_outside_their_space_are_faults(monkeypatch):
    real, change = BatchVecEnv.step_wait, {}

    def step(self):
        observations, *rest = real(self)
        return {**observations, **change}, *rest

    monkeypatch.setattr(BatchVecEnv, "step_wait", step)
    monkeypatch.setattr(soak, "ENVIRONMENTS", 2)
    for name, part in (("ego", np.full((2, 9), 2, np.float32)), ("mask", np.full((2, 6), 2, "i1"))):
        change.update({name: part})
        result = soak.soak("highway-fast", tiny(vec="batch"), 3, 0)
        assert result.faults[0] == "step 2: an observation outside its space"
        assert len(result.faults) == 2
        change.clear()
    assert soak.soak("highway-fast", tiny(vec="batch"), 3, 0).faults == []
