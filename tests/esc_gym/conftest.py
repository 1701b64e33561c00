"""``pytest tests/esc_gym/... --exact-seeds 100 -n 2``: as many episodes as one has time for."""

from __future__ import annotations

import pytest

CHUNK = 5
AT_ONCE = 1  # seeds in the ordinary tests; up to CHUNK is slow
SEEDS_A_DRAW = 50  # for so many seeds, one more configuration: the own one, then random ones


def pytest_addoption(parser):
    parser.addoption("--exact-seeds", type=int, help="episodes of each; default 1, and 4 slow ones")


def pytest_generate_tests(metafunc: pytest.Metafunc):
    """Tests with an argument ``seeds`` get some at a time, to be spread over workers.

    Those with ``drawn``, the number of a random configuration: 0 for the id's own.
    """
    # None also where pytest was started elsewhere and did not see the option above.
    count = metafunc.config.getoption("exact_seeds", None)
    if "drawn" in metafunc.fixturenames:
        metafunc.parametrize("drawn", range(count // SEEDS_A_DRAW) if count else [1])
    if "seeds" not in metafunc.fixturenames:
        return
    if count:
        chunks = [range(s, min(s + CHUNK, count)) for s in range(0, count, CHUNK)]
        cases = [pytest.param(chunk, id=_name(chunk)) for chunk in chunks]
    else:
        first, rest = range(AT_ONCE), range(AT_ONCE, CHUNK)
        slow = pytest.param(rest, id=_name(rest), marks=pytest.mark.slow)
        cases = [pytest.param(first, id=_name(first)), slow]
    metafunc.parametrize("seeds", cases)


def _name(seeds: range) -> str:
    return f"{seeds[0]}-{seeds[-1]}"
