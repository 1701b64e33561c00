"""A finished comparison that the tests of engines and of the report share."""

import shutil

import pytest

from esc_agents.compare.comparison import compare
from tests.esc_agents.compare.small import HereEngine, small


@pytest.fixture(scope="session")
def compared(tmp_path_factory):
    out = tmp_path_factory.mktemp("compared")
    compare(small(), out, HereEngine())
    return out


@pytest.fixture
def own(compared, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(compared, tmp_path / "own")
