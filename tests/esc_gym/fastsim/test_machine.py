"""Exact or stock: what the self-checks find, and what they do then."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import esc_gym
from esc_gym.fastsim import engine, kernel, known, numerics
from esc_gym.fastsim.numerics import ROUNDED, WIDTHS
from tests.esc_gym.fastsim.lockstep import lockstep


def test_this_machine_is_reproduced():
    found, problem = numerics.measure(kernel.check, count=5000)
    assert problem == ""
    assert found is not None


@pytest.mark.parametrize("name", WIDTHS)
def test_one_wrong_bit_is_found(name):
    """A kernel that is off by one ulp, once, in one function, in every rounding."""
    column = sum(list(WIDTHS.values())[: list(WIDTHS).index(name)])

    def check(addresses, inputs, outputs):
        kernel.check(addresses, inputs, outputs)
        outputs[7, column] = np.nextafter(outputs[7, column], np.inf)

    found, problem = numerics.measure(check)
    assert found is None
    group = next((group for group in ROUNDED if name in group), (name,))
    assert set(group) <= set(problem.partition(" in ")[2].split(", "))


def test_the_rounding_that_agrees_is_taken():
    """Whichever of the forms NumPy's products have, the kernels follow."""
    for wanted in (numerics.PLAIN, numerics.FUSED_SECOND, numerics.FUSED_FIRST):

        def check(addresses, inputs, outputs, wanted=wanted):
            # Every rounding but the wanted one fails; the wanted one is what NumPy does here.
            outputs[:] = numerics._truth(inputs)
            if addresses[-1] != wanted:
                outputs[3, list(WIDTHS).index("dot") :] += 1.0

        found, _ = numerics.measure(check)
        assert found[-3:] == (wanted, wanted, wanted)


def another_highway_env(monkeypatch):
    monkeypatch.setattr(known, "SOURCE", "another")


def other_numerics(monkeypatch):
    monkeypatch.setattr(numerics, "measure", lambda check: (None, "NumPy rounds otherwise in tan"))


@pytest.mark.parametrize("change", [another_highway_env, other_numerics])
def test_stock_code_and_a_warning(change, monkeypatch):
    change(monkeypatch)
    with pytest.warns(UserWarning, match="highway-env's own code"):
        found = engine.machine.__wrapped__()
    monkeypatch.setattr(engine, "machine", lambda: found)
    lockstep(lambda: gym.make("merge-v0"), steps=4, compiled=False)
    lockstep(lambda: gym.make("intersection-v0"), steps=2, seeds=[0], compiled=False)


def test_report():
    env = gym.make("esc_gym/merge-v0")
    env.reset(seed=0)
    env.step(1)
    env.unwrapped.road.record_history = True
    env.step(1)
    report = esc_gym.fastsim.report(env)
    assert (report.compiled, report.stock) == (1, {"trajectories are recorded": 1})
    assert str(report).splitlines() == [
        "1 policy steps compiled, 1 stock",
        "  1 stock: trajectories are recorded",
    ]
    assert str(esc_gym.fastsim.report(gym.make("merge-v0"))).startswith("0 policy steps")


def test_accelerate_false_is_stock():
    env = gym.make("esc_gym/merge-v0", accelerate=False)
    env.reset(seed=0)
    env.step(1)
    assert esc_gym.fastsim.report(env).stock == {"acceleration is off": 1}


def test_only_highway_env():
    with pytest.raises(TypeError, match="expected a highway-env environment, got CartPoleEnv"):
        esc_gym.accelerate(gym.make("CartPole-v1"))
