"""For all tests."""

import os
import tempfile

import pytest

from esc_gym.fastsim.engine import machine

# The key of checkpoints: of the tests alone, and of the processes that they start.
os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="esc-gym-tests-")


@pytest.fixture(scope="session", autouse=True)
def _compiled():
    """Whatever a test says about its output, a machine's first compilation is not part of it."""
    machine()
