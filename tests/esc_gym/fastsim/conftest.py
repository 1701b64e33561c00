"""``pytest tests/esc_gym/fastsim --exact-seeds 100 -n 2``: as many episodes as one has time for."""

from __future__ import annotations

import pytest

CHUNK = 5


def pytest_addoption(parser):
    parser.addoption("--exact-seeds", type=int, help="episodes of each environment, default 5")


def pytest_generate_tests(metafunc: pytest.Metafunc):
    """Tests with an argument ``seeds`` get them five at a time, to be spread over workers."""
    if "seeds" in metafunc.fixturenames:
        # None also where pytest was started elsewhere and did not see the option above.
        count = metafunc.config.getoption("exact_seeds", None) or CHUNK
        chunks = [range(s, min(s + CHUNK, count)) for s in range(0, count, CHUNK)]
        metafunc.parametrize("seeds", chunks, ids=[f"{c[0]}-{c[-1]}" for c in chunks])
