"""The compiled generator against NumPy's, draw for draw."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from esc_gym.vector import generators


@numba.njit
def draw(g, kinds, values):
    """A number of each kind in turn: random, below, uniform, normal."""
    for i in range(len(kinds)):
        if kinds[i] == 0:
            values[i] = generators.random(g)
        elif kinds[i] == 1:
            values[i] = generators.below(g, 1 + i % 9)
        elif kinds[i] == 2:
            values[i] = generators.below(g, 4_000_000_000)
        elif kinds[i] == 3:
            values[i] = generators.uniform(g, -3.0, 8.5)
        else:
            values[i] = generators.normal(g)


@numba.njit
def shuffled(g, items, count):
    generators.shuffle(g, items, count)


@pytest.mark.parametrize("seed", range(10))
def test_the_same_stream(seed):
    theirs = np.random.default_rng(seed)
    mine = generators.row(theirs)
    kinds, values = np.random.default_rng(seed + 100).integers(0, 5, 500), np.zeros(500)
    draw(mine, kinds, values)
    for i, kind in enumerate(kinds):
        expected = (
            theirs.random, lambda i=i: theirs.choice(1 + i % 9),
            lambda: theirs.integers(0, 4_000_000_000), lambda: theirs.uniform(-3.0, 8.5),
            theirs.normal,
        )[kind]()  # fmt: skip
        assert values[i] == expected
    items = np.arange(30)
    shuffled(mine, items, 17)
    assert (items[:17] == theirs.permutation(17)).all()
    assert (generators.row(theirs) == mine).all()
    assert generators.generator(mine).random() == theirs.random()


@pytest.mark.slow
def test_the_tails_of_the_normal():
    theirs = np.random.default_rng(5)
    mine, values = generators.row(theirs), np.zeros(1_000_000)
    draw(mine, np.full(len(values), 4), values)
    assert (values == theirs.normal(size=len(values))).all()
    assert np.abs(values).max() > generators._TAIL  # the rarest of the branches


def test_another_generator_is_refused():
    with pytest.raises(TypeError, match="expected a PCG64 generator, got MT19937"):
        generators.row(np.random.Generator(np.random.MT19937(0)))
