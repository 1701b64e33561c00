"""Encoders that pool, against the formulas, derived again with a loop over sets and over rows."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from torch import Tensor, nn

from esc_gym.encoders import (
    AttentionEncoder,
    ESCEncoder,
    ESCExpEncoder,
    MaxEncoder,
    MeanEncoder,
)
from tests.esc_gym import encoding
from tests.esc_gym.encoding import (
    D1,
    D2,
    POOLING,
    TOLERANCE,
    N,
    build,
    gradients,
    scene,
    scenes,
)  # fmt: skip


def h(encoder: Any, row: Tensor) -> Tensor:
    """The feature network on one row, from its weights alone."""
    for layer in encoder.layers:
        if isinstance(layer, nn.Linear):
            row = row @ layer.weight.T + layer.bias
        else:
            row = 0.5 * row * (1 + torch.erf(row / math.sqrt(2)))
    return row @ encoder.output.weight.T + encoder.output.bias


def attend(encoder: Any, rows: list[Tensor], ego: Tensor) -> Tensor:
    """Ego attention over the rows of one set, head by head."""
    answers, width, total = [], encoder.width, encoder.heads * encoder.width
    mixed = [encoder.key_value(encoder.layers(row)) for row in rows]
    for head in range(encoder.heads):
        own = slice(head * width, (head + 1) * width)
        query = encoder.query(ego)[own]
        scores = torch.stack([query @ row[:total][own] / math.sqrt(width) for row in mixed])
        values = torch.stack([row[total:][own] for row in mixed])
        answers.append(torch.softmax(scores, dim=0) @ values)
    return encoder.output(torch.cat(answers))


POOLED: dict[type, Callable[[Tensor], Tensor]] = {
    ESCEncoder: lambda each: each.sum(0),
    ESCExpEncoder: lambda each: (1 + (100 * each).clamp(max=80).exp().sum(0)).log() / 100,
    MeanEncoder: lambda each: each.mean(0),
    MaxEncoder: lambda each: each.amax(0),
}


def naive(encoder: Any, vehicles: Tensor, mask: Tensor, ego: Tensor) -> Tensor:
    """The definition of each pooling representation, one set at a time."""
    codes = []
    for b in range(len(mask)):
        rows = [vehicles[b, i] for i in range(mask.shape[1]) if mask[b, i]]
        if not rows:
            codes.append(torch.zeros(encoder.code_dim))
        elif isinstance(encoder, AttentionEncoder):
            codes.append(attend(encoder, rows, ego[b]))
        else:
            each = torch.stack([h(encoder, row) for row in rows])
            codes.append(POOLED[type(encoder)](each))
    return torch.cat([torch.stack(codes), ego], dim=1)


@pytest.mark.parametrize("name", POOLING)
@given(scenes)
@settings(max_examples=25, deadline=None)
def test_pooling_equals_naive_formula(name, drawn):
    seed, counts = drawn
    encoder, inputs = build(name), scene(counts, seed)
    output, expected = encoder(*inputs), naive(encoder, *inputs)
    torch.testing.assert_close(output, expected, **TOLERANCE)
    torch.testing.assert_close(
        gradients(encoder, output), gradients(encoder, expected), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("name", POOLING)
def test_rows_may_lie_anywhere_under_the_mask(name):
    vehicles, _, ego = scene([N, N])
    mask = torch.tensor([[0, 1, 0, 0, 1, 1], [1, 0, 1, 0, 0, 0]])
    encoder = build(name)
    torch.testing.assert_close(
        encoder(vehicles, mask, ego), naive(encoder, vehicles, mask, ego), **TOLERANCE
    )


@pytest.mark.parametrize("name", POOLING)
@given(scenes)
@settings(max_examples=25, deadline=None)
def test_growing_the_padding_changes_nothing(name, drawn):
    seed, counts = drawn
    encoder, (vehicles, mask, ego) = build(name), scene(counts, seed)
    wide = torch.zeros(len(counts), 4 * N, D1)
    wide[:, :N] = vehicles
    wide_mask = nn.functional.pad(mask, (0, 3 * N))
    torch.testing.assert_close(
        encoder(wide, wide_mask, ego), encoder(vehicles, mask, ego), **TOLERANCE
    )


def test_esc_counts_duplicates_twice_and_mean_does_not():
    vehicles, _, ego = scene([1])
    twice = vehicles[:, [0, 0, 1, 2, 3, 4]]
    one, two = torch.tensor([[1, 0, 0, 0, 0, 0]]), torch.tensor([[1, 1, 0, 0, 0, 0]])
    esc, mean = build("esc"), build("mean")
    code = esc(vehicles, one, ego)[:, :-D2]
    assert code.abs().max() > 0.01
    torch.testing.assert_close(esc(twice, two, ego)[:, :-D2], 2 * code, **TOLERANCE)
    torch.testing.assert_close(mean(twice, two, ego), mean(vehicles, one, ego), **TOLERANCE)


def test_esc_scale_multiplies_the_code_only():
    inputs = scene([0, 4])
    plain, scaled = build("esc")(*inputs), build("esc", scale=0.1)(*inputs)
    torch.testing.assert_close(scaled[:, :-D2], plain[:, :-D2] / 10)
    torch.testing.assert_close(scaled[:, -D2:], plain[:, -D2:])


@pytest.mark.parametrize("sharpness", [0.5, 30.0, 1000.0])
def test_esc_exp_is_a_maximum_softened_from_above(sharpness):
    """Within log(1 + M) / sharpness, and it knows of a vehicle that is there twice."""
    vehicles, mask, ego = scene([1, 4, N])
    encoder = build("esc-exp", sharpness=sharpness)
    code = encoder(vehicles, mask, ego)[:, :-D2]
    greatest = torch.stack(
        [torch.stack([h(encoder, row) for row in rows[real]]).amax(0).clamp(0, 80 / sharpness)
         for rows, real in zip(vehicles, mask.bool(), strict=True)]
    )  # fmt: skip
    above = code - greatest
    assert above.min() > -1e-6
    assert (above <= (1 + mask.sum(1, keepdim=True)).log() / sharpness + 1e-6).all()
    twice = encoder(vehicles[:1, [0, 0, 1]], torch.tensor([[1, 1, 0]]), ego[:1])[:, :-D2]
    assert (twice > code[:1]).any()


def test_esc_exp_survives_exponents_of_any_size():
    encoder, (vehicles, mask, ego) = build("esc-exp"), scene([0, 4, N])
    for factor in (-1e6, 1e6):
        output = encoder(vehicles * factor, mask, ego)
        assert output.isfinite().all()
        assert all(g.isfinite().all() for g in gradients(encoder, output).values())


def test_attention_depends_on_the_ego_and_survives_large_scores():
    encoder, (vehicles, mask, ego) = build("attention"), scene([4, 6])
    code, other = (encoder(vehicles, mask, e)[:, :-D2] for e in (ego, ego + 1))
    assert not torch.allclose(code, other, **TOLERANCE)
    assert encoder(vehicles, mask, ego * 1e6).isfinite().all()


def test_d3_rule_warns_once_with_the_number_needed():
    with pytest.warns(UserWarning, match=r"code_dim=18 .* 19") as caught:
        build("esc", code_dim=N * D1)
    assert [warning.filename for warning in caught] == [encoding.__file__]
    build("esc", code_dim=N * D1 + 1)  # enough: warnings are errors here
    build("mean", code_dim=2)  # the theorem is about sums
