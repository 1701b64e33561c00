"""The paper's table of benchmarks, transcribed once more, with loops and in float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from esc_agents.paper.targets import EGO_DIM, MAX_VEHICLES, TARGETS, VEHICLE_DIM, Sets


def norm(x, p):
    return sum(abs(v) ** p for v in x) ** (1 / p)


def mean(x):
    return sum(x) / len(x)


def transcribed(number, X, e):
    """X: list of vehicles, e: the ego, as in the table."""
    match number:
        case 1:
            return (
                mean(e)
                - 0.2 * min(norm(x, 3) for x in X)
                + 0.4 * mean([norm(x, 1) for x in X]) * max(norm(x, 2) for x in X)
            )
        case 2:
            return 0.5 * min(e) * max(max(x) for x in X) * min(norm(x, 4) for x in X)
        case 3:
            return 0.2 * norm(e, 3) + 2 * mean([norm(x, 1) for x in X]) * mean([max(x) for x in X])
        case 4:
            return 5 * norm(e, 2) * norm([min(x) / (norm(x, 2) + 0.1) for x in X], 4)
        case 5:
            terms = [mean(x) * max(x) / (norm(x, 4) + 0.1) for x in X]
            return 10 * norm(e, 4) * mean(terms)
        case 6:
            return 8 * norm(e, 2) * max(mean(x) * norm(x, 3) / (norm(x, 2) + 0.1) for x in X)


def random_sets(count, size, seed=0):
    rng = np.random.default_rng(seed)
    vehicles = rng.uniform(-5, 5, (count, MAX_VEHICLES, VEHICLE_DIM))
    mask = np.arange(MAX_VEHICLES) < np.full((count, 1), size)
    ego = rng.uniform(-5, 5, (count, EGO_DIM))
    return Sets(*map(torch.tensor, (vehicles, mask, ego)))


@pytest.mark.parametrize("size", [1, 7, 20])
@pytest.mark.parametrize("number", TARGETS)
def test_as_in_the_table(number, size):
    """Rows past M hold numbers here, and must not count."""
    sets = random_sets(30, size)
    expected = [
        transcribed(number, x[:size].tolist(), e.tolist())
        for x, e in zip(sets.vehicles, sets.ego, strict=True)
    ]
    np.testing.assert_allclose(TARGETS[number](sets), expected, rtol=1e-10)


@pytest.mark.parametrize("number", TARGETS)
def test_order_and_place_do_not_matter(number):
    sets = random_sets(30, 12)
    order = torch.randperm(MAX_VEHICLES, generator=torch.Generator().manual_seed(0))
    moved = Sets(sets.vehicles[:, order], sets.mask[:, order], sets.ego)
    target = TARGETS[number]
    torch.testing.assert_close(target(moved), target(sets))
    other = Sets(sets.vehicles.flip(1), sets.mask, sets.ego)  # other vehicles: another value
    assert not torch.isclose(target(other), target(sets)).all()


@pytest.mark.parametrize("number", TARGETS)
def test_a_vehicle_at_the_origin(number):
    """Norms of zero, where derivatives end, have values."""
    sets = Sets(torch.zeros(1, 2, 5), torch.ones(1, 2, dtype=torch.bool), torch.ones(1, EGO_DIM))
    expected = transcribed(number, [[0.0] * 5] * 2, [1.0] * EGO_DIM)
    np.testing.assert_allclose(TARGETS[number](sets), [expected], rtol=1e-6)
