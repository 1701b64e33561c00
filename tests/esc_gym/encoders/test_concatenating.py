"""FP and AP: which rows take which slots of their network."""

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.esc_gym.encoding import D2, N, build, scene


def table(encoder: Any, rows: list[list[float]]) -> Tensor:
    """Code of one set, given as the list of rows that the network should see."""
    return encoder.output(encoder.layers(torch.tensor(rows).flatten()))


def code(encoder: Any, rows: list[list[float]], count: int) -> Tensor:
    mask = (torch.arange(len(rows)) < count)[None]
    return encoder(torch.tensor(rows)[None], mask, torch.zeros(1, D2))[0, :-D2]


NEAR, MIDDLE, FAR = [-0.1, 0.2, 5.0], [0.0, -0.4, 1.0], [0.9, 0.0, 3.0]
JUNK, VIRTUAL = [0.01, 0.01, 9.0], [1.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("name", "sort", "seen"),
    [
        ("ap", {}, [FAR, NEAR, MIDDLE]),
        ("fp", {}, [NEAR, MIDDLE, FAR]),
        ("fp", {"sort": "lexicographic"}, [NEAR, MIDDLE, FAR]),
    ],
)
def test_rows_take_the_slots_in_the_declared_order(name, sort, seen):
    encoder = build(name, max_vehicles=5, **sort)
    given_rows = [FAR, NEAR, MIDDLE, JUNK, JUNK]
    torch.testing.assert_close(
        code(encoder, given_rows, 3), table(encoder, [*seen, VIRTUAL, VIRTUAL])
    )


def test_lexicographic_order_compares_later_columns_on_ties():
    a, b, c, d = [0.2, -0.5, 1.0], [0.2, 0.1, -2.0], [0.2, 0.1, 0.0], [-0.9, 0.9, 0.9]
    encoder = build("fp", max_vehicles=4, sort="lexicographic")
    torch.testing.assert_close(code(encoder, [c, b, d, a], 4), table(encoder, [d, a, b, c]))


def test_equal_distances_keep_the_order_given():
    rows = [[0.5, 0.25 * (-1) ** i, float(i)] for i in range(40)]
    encoder = build("fp", max_vehicles=len(rows))
    for order in (rows, rows[::-1]):
        torch.testing.assert_close(code(encoder, order, len(rows)), table(encoder, order))


def test_distance_is_metric_whatever_the_scale_of_the_columns():
    # 200 m are 1 in x and 10 in y: 60 m ahead is nearer than 80 m to the side, 0.3 < 4.0.
    ahead, beside, behind = [0.3, 0.0, 1.0], [0.0, 4.0, 2.0], [-0.1, 0.0, 3.0]
    metric = build("fp", max_vehicles=3, high=[1.0, 10.0, 1.0])
    torch.testing.assert_close(
        code(metric, [beside, ahead, behind], 3), table(metric, [behind, ahead, beside])
    )
    near_side = [0.0, 2.0, 2.0]  # 40 m to the side, nearer than 60 m ahead though 2.0 > 0.3
    torch.testing.assert_close(
        code(metric, [ahead, near_side, behind], 3), table(metric, [behind, near_side, ahead])
    )


def test_columns_scaled_off_center():
    # x scaled by the range (0, 200): -1 is 0 m, 1 is 200 m, -3 is 200 m behind; virtual is at 1.
    encoder = build("fp", max_vehicles=3, low=[-3.0, -1.0, -1.0], high=[1.0, 1.0, 1.0])
    close, further = [-1.1, 0.0, 0.0], [0.0, 0.0, 0.0]  # 10 m behind, 100 m ahead
    torch.testing.assert_close(
        code(encoder, [further, close, JUNK], 2), table(encoder, [close, further, VIRTUAL])
    )


def test_position_columns_may_be_elsewhere():
    encoder = build("fp", max_vehicles=2, position=(2, 0), high=[2.0, 1.0, 3.0])
    close, further = [0.0, 1.0, 0.3], [0.0, 0.0, -0.9]
    torch.testing.assert_close(code(encoder, [further, close], 2), table(encoder, [close, further]))
    torch.testing.assert_close(
        code(encoder, [close, further], 0), table(encoder, [[0.0, 0.0, 3.0]] * 2)
    )


@pytest.mark.parametrize(
    ("name", "sort", "seen"),
    [
        ("ap", {}, [FAR, NEAR]),
        ("fp", {}, [NEAR, MIDDLE]),
        ("fp", {"sort": "lexicographic"}, [NEAR, MIDDLE]),
    ],
)
def test_slots_keep_the_first_in_order_and_take_any_number_of_rows(name, sort, seen):
    encoder = build(name, slots=2, **sort)
    torch.testing.assert_close(code(encoder, [FAR, NEAR, MIDDLE, JUNK], 3), table(encoder, seen))
    torch.testing.assert_close(code(encoder, [NEAR], 1), table(encoder, [NEAR, VIRTUAL]))


def test_lexicographic_slots_go_to_the_nearest():
    encoder = build("fp", slots=2, sort="lexicographic")
    far_left = [-0.95, 0.0, 0.0]
    torch.testing.assert_close(
        code(encoder, [far_left, MIDDLE, NEAR], 3), table(encoder, [NEAR, MIDDLE])
    )


@pytest.mark.parametrize("name", ["ap", "fp"])
def test_another_number_of_rows_is_refused(name):
    with pytest.raises(ValueError, match=r"expected 6 rows, as built, got 24; pass slots=Z"):
        build(name)(*scene([3], rows=4 * N))


# -- parameter counts -----------------------------------------------------------------------------
