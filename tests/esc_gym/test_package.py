"""What ``import esc_gym`` loads and offers."""

from __future__ import annotations

import subprocess
import sys

import highway_env  # noqa: F401
import pytest
from highway_env.vehicle.kinematics import Vehicle

import esc_gym
from esc_gym.features import DEFAULT_FEATURES, VEHICLE_FEATURES


def test_import_loads_neither_torch_nor_sb3():
    code = (
        "import sys, esc_gym; heavy = {'torch', 'stable_baselines3', 'numba'} & set(sys.modules); "
        "assert not heavy, heavy; import esc_gym.extractors; assert 'torch' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_table_of_contents():
    assert set(esc_gym.__all__) <= set(dir(esc_gym))
    for name in esc_gym.__all__:
        assert getattr(esc_gym, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = esc_gym.nothing
    assert set(DEFAULT_FEATURES) <= set(VEHICLE_FEATURES)
    assert Vehicle.MAX_SPEED == 40.0  # the tables were read off this highway-env
