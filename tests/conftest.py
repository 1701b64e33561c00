"""For all tests."""

import pytest

from esc_gym.fastsim.engine import machine


@pytest.fixture(scope="session", autouse=True)
def _compiled():
    """Whatever a test says about its output, a machine's first compilation is not part of it."""
    machine()
