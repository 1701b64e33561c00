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


def pytest_collection_modifyitems(items):
    """Tests of one finished comparison go to one worker of xdist, so that it is made once."""
    for item in items:
        if "compare" in item.path.parts and "compared" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.xdist_group("compared"))
