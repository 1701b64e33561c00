"""Sums of powers and their inverses, against the definitions and the sets that they came from."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from esc_gym.encoders import ESCEncoder
from esc_gym.theory import (
    column_code,
    columns,
    linked_code,
    required_code_dim,
    vehicles,
)

N, D1 = 8, 3
CODES = (column_code, linked_code)


VALUES = st.floats(-1, 1, width=32)
SETS = st.integers(0, N).flatmap(lambda count: arrays(float, (count, D1), elements=VALUES))


def apart(seed, count):
    """Random vehicles whose first features are at least 0.1 apart."""
    rng = np.random.default_rng(seed)
    found = rng.uniform(-1, 1, (count, D1))
    found[:, 0] = np.linspace(-0.9, 0.9, count) + rng.uniform(-0.05, 0.05, count)
    return rng.permutation(found)


def by_first(found):
    return found[found[:, 0].argsort()]


@given(SETS)
def test_column_code_by_its_definition(found):
    expected = [sum(x[j] ** p for x in found) for j in range(D1) for p in range(1, N + 1)]
    np.testing.assert_allclose(column_code(found, N), [*expected, len(found)], atol=1e-12)


@given(SETS)
def test_linked_code_by_its_definition(found):
    expected = [sum(x[0] ** p for x in found) for p in range(1, N + 1)]
    expected += [sum(x[0] ** p * x[j] for x in found) for j in range(1, D1) for p in range(N)]
    np.testing.assert_allclose(linked_code(found, N), [*expected, len(found)], atol=1e-12)


@pytest.mark.parametrize("code", CODES)
def test_as_long_as_the_rule_says_and_the_encoder_by_default(code):
    encoder = ESCEncoder(vehicle_dim=D1, ego_dim=2, max_vehicles=N)
    assert len(code(apart(0, 3), N)) == required_code_dim(N, D1) == encoder.code_dim == 25


@pytest.mark.parametrize("code", CODES)
def test_order_does_not_matter(code):
    found = apart(1, 4)
    for order in permutations(range(4)):
        np.testing.assert_allclose(code(found[list(order)], N), code(found, N), atol=1e-14)


@pytest.mark.parametrize("code", CODES)
def test_the_count_tells_sets_of_zeros_apart(code):
    """Powers of 0 add nothing: without the last number these would be one code."""
    found = [code(np.zeros((count, D1)), N) for count in range(N + 1)]
    assert len({tuple(row) for row in found}) == N + 1
    assert len({tuple(row[:-1]) for row in found}) == 1


@settings(deadline=None)
@given(st.integers(0, 10_000), st.integers(0, N))
def test_columns_come_back(seed, count):
    found = np.random.default_rng(seed).uniform(-1, 1, (count, D1))
    back = columns(column_code(found, N), N)
    assert back.shape == (D1, count)
    np.testing.assert_allclose(back, np.sort(found, axis=0).T, atol=1e-5)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_equal_vehicles_come_back(count):
    """A root of order m is as exact as the m-th root of the rounding."""
    found = np.full((count, D1), [0.25, -0.5, 1.0])
    back = columns(column_code(found, N), N)
    np.testing.assert_allclose(back, found.T, atol=2e-3)


@settings(deadline=None)
@given(st.integers(0, 10_000), st.integers(0, N))
def test_vehicles_come_back_whole(seed, count):
    found = apart(seed, count)
    back = vehicles(linked_code(found, N), N)
    assert back.shape == (count, D1)
    np.testing.assert_allclose(back, by_first(found), atol=1e-6)


def test_the_proof_forgets_which_values_belong_together():
    one, other = np.array([[0.0, 0.0], [1.0, 1.0]]), np.array([[0.0, 1.0], [1.0, 0.0]])
    assert np.array_equal(column_code(one, N), column_code(other, N))
    assert not np.allclose(linked_code(one, N), linked_code(other, N))
    np.testing.assert_allclose(vehicles(linked_code(one, N), N), one, atol=1e-9)
    np.testing.assert_allclose(vehicles(linked_code(other, N), N), other, atol=1e-9)


def test_where_first_features_agree_only_sums_are_kept():
    one, other = np.array([[0.5, 0.2], [0.5, 0.4]]), np.array([[0.5, 0.1], [0.5, 0.5]])
    np.testing.assert_allclose(linked_code(one, N), linked_code(other, N), atol=1e-15)
    with pytest.raises(ValueError, match="share their first feature"):
        vehicles(linked_code(one, N), N)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.zeros(3), r"expected shape \[M, d1\]"),
        (np.zeros((N + 1, 2)), "at most N = 8, got 9"),
        (np.full((1, 2), 1.5), r"values in \[-1, 1\]"),
        (np.full((1, 2), np.nan), r"values in \[-1, 1\]"),
    ],
)
@pytest.mark.parametrize("code", CODES)
def test_sets_that_have_no_code(code, given, message):
    with pytest.raises(ValueError, match=message):
        code(given, N)


@pytest.mark.parametrize("inverse", [columns, vehicles])
def test_codes_of_no_set(inverse):
    with pytest.raises(ValueError, match=r"N\*d1 \+ 1 numbers, N = 8"):
        inverse(np.zeros(18), N)
    with pytest.raises(ValueError, match=r"a count in 0..8, got 9"):
        inverse([*np.zeros(16), 9.0], N)
