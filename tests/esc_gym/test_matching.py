"""As many parameters for every representation."""

from typing import Any

import pytest
import torch

from esc_gym.encoders import (
    REPRESENTATIONS,
    ESCEncoder,
)
from esc_gym.matching import matched_hidden, parameter_count
from tests.esc_gym.encoding import NAMES, build


@pytest.mark.parametrize(
    ("d1", "d2", "n", "hidden", "code_dim"),
    [(7, 9, 50, (128, 128), None), (7, 9, 50, (256, 256), None), (5, 12, 20, (64, 64), None),
     (7, 9, 15, (128, 64, 32), None), (5, 10, 20, (256,) * 5, 101), (6, 4, 8, (96,), 49)],
)  # fmt: skip
@pytest.mark.parametrize("name", NAMES)
def test_parameter_counts_match_within_5_percent(name, d1, d2, n, hidden, code_dim):
    dims: dict[str, Any] = {
        "vehicle_dim": d1,
        "ego_dim": d2,
        "max_vehicles": n,
        "code_dim": code_dim,
    }
    esc = parameter_count(ESCEncoder(**dims, hidden=hidden))
    widths = matched_hidden(name, **dims, hidden=hidden)
    count = parameter_count(REPRESENTATIONS[name](**dims, hidden=widths))
    assert abs(count - esc) <= 0.05 * esc
    assert len(widths) == len(hidden)
    assert (
        max(abs(w / widths[0] - v / hidden[0]) for w, v in zip(widths, hidden, strict=True)) < 0.05
    )
    if name == "esc":
        assert widths == hidden


def test_parameter_count_is_that_of_the_formula():
    esc = build("esc")
    assert parameter_count(esc) == (3 * 16 + 16) + (16 * 8 + 8) + (8 * 19 + 19)
    esc.output.bias.requires_grad_(False)
    assert parameter_count(esc) == (3 * 16 + 16) + (16 * 8 + 8) + 8 * 19


def test_matching_draws_no_random_numbers():
    state = torch.get_rng_state()
    matched_hidden("fp", vehicle_dim=7, ego_dim=9, max_vehicles=50)
    assert torch.equal(state, torch.get_rng_state())


def test_matching_out_of_reach_warns():
    # One unit of fp with 50 vehicles already has more parameters than this ESC.
    dims: dict[str, Any] = {"vehicle_dim": 7, "ego_dim": 9, "max_vehicles": 50, "hidden": (2,)}
    dims["code_dim"] = 10
    with pytest.warns(UserWarning, match="Theorem 1"):
        assert parameter_count(ESCEncoder(**dims)) == 16 + 30
    with pytest.warns(UserWarning, match="more than 5 % off"):
        assert matched_hidden("fp", **dims) == (1,)


# -- errors and registry --------------------------------------------------------------------------
