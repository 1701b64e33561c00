"""The networks are the paper's, and what is trained is what they say."""

from __future__ import annotations

import warnings
from itertools import pairwise

import pytest
import torch
from torch import nn

from esc_agents.paper import cells as cells_module
from esc_agents.paper.cells import Cell, Policy, train
from esc_agents.paper.samples import COUNTS, Samples
from esc_agents.paper.targets import Sets
from esc_gym.encoders import REPRESENTATIONS


def chain(widths, gelu):
    """Layers by their widths; ``gelu``: whether each is followed by one."""
    layers = []
    for (inputs, outputs), active in zip(pairwise(widths), gelu, strict=True):
        layers += [nn.Linear(inputs, outputs), *[nn.GELU()] * active]
    return nn.Sequential(*layers)


def parameters(module):
    return sum(p.numel() for p in module.parameters())


BEFORE, AFTER = [True] * 5 + [False], [True] * 5 + [False]


@pytest.mark.parametrize("repr", ["esc", "fp", "ap"])
def test_the_papers_networks(repr):
    """Eleven hidden layers with 101 linear units in the middle, where x_else joins."""
    size = 5
    policy = Policy(Cell(1, size, repr, 0))
    inputs = 5 if repr == "esc" else 5 * size
    first = chain([inputs, *[256] * 5, 101], BEFORE)
    second = chain([111, *[256] * 5, 1], AFTER)
    assert parameters(policy) == parameters(first) + parameters(second)
    first.load_state_dict(renamed(policy.encoder.state_dict(), first))
    head = {key: value for key, value in policy.state_dict().items() if "encoder" not in key}
    second.load_state_dict(renamed(head, second))
    sets = Samples("test", 0, size).draw(torch.arange(64))
    x = sets.vehicles
    if repr == "esc":
        code = first(x).sum(dim=1)
    else:
        order = x[:, :, 0].argsort(dim=1) if repr == "fp" else torch.arange(5).expand(64, 5)
        code = first(x.gather(1, order[:, :, None].expand_as(x)).flatten(1))
    expected = second(torch.cat([code, sets.ego], dim=1)).squeeze(1)
    torch.testing.assert_close(policy(sets), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("repr", REPRESENTATIONS)
def test_a_captured_graph_learns_as_without(repr, monkeypatch):
    cells = [Cell(3, 5, repr, seed) for seed in (0, 4)]
    captured = train(cells, 20, "cuda")
    monkeypatch.setattr(cells_module, "WARM_UP", 1000)
    for (_, points), (_, expected) in zip(captured, train(cells, 20, "cuda"), strict=True):
        assert points[-1].errors[5] == pytest.approx(expected[-1].errors[5], rel=1e-4)


def renamed(state, module):
    return dict(zip(module.state_dict(), state.values(), strict=True))


@pytest.mark.parametrize("repr", REPRESENTATIONS)
def test_a_few_updates_lessen_the_error(repr):
    """Of the same policy: a longer training starts as a shorter one does."""
    (few,), (more,) = (train([Cell(1, 5, repr, 0)], updates, "cpu")[0][1] for updates in (1, 8))
    assert (few.update, more.update) == (1, 8)
    assert more.errors[5] < few.errors[5]


def test_variable_sizes_are_tested_on_four():
    ticks = []
    ((_, points),) = train([Cell(2, None, "esc", 1)], 3, "cpu", ticks.append)
    assert ticks == [1, 2, 3]
    assert list(points[-1].errors) == [5, 10, 15, 20]


def test_the_same_seed_gives_the_same_errors():
    first, second, other = (train([Cell(3, 5, "fp", seed)], 5, "cpu")[0][1] for seed in (0, 0, 1))
    assert first == second
    assert first != other


def test_padding_is_not_seen():
    sets = Samples("test", 0, None).draw(torch.arange(32))
    policy = Policy(Cell(1, None, "esc", 0))
    filled = Sets(torch.where(sets.mask[:, :, None], sets.vehicles, 7.0), sets.mask, sets.ego)
    assert torch.equal(policy(sets), policy(filled))


@pytest.mark.parametrize("init", ["glorot", "torch"])
def test_how_weights_start(init):
    """Uniform, whose deviation is its bound over the root of 3."""
    policy = Policy(Cell(1, 20, "esc", 0, init=init))
    for layer in (layer for layer in policy.modules() if isinstance(layer, nn.Linear)):
        outputs, inputs = layer.weight.shape
        bound = (6 / (inputs + outputs)) ** 0.5 if init == "glorot" else inputs**-0.5
        assert layer.weight.abs().max() <= bound
        if layer.weight.numel() > 10_000:
            assert layer.weight.std().item() == pytest.approx(bound / 3**0.5, rel=0.02)
        assert layer.bias.any() == (init == "torch")


def test_no_warnings_at_the_papers_code_dimension():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Policy(Cell(1, 20, "esc", 0))


@pytest.mark.parametrize(
    ("repr", "size"), [*((repr, 3) for repr in REPRESENTATIONS), ("esc", None), ("esc", 20)]
)
def test_seeds_at_once_are_seeds_one_by_one(repr, size, monkeypatch):
    monkeypatch.setitem(COUNTS, "test", 64)
    cells = [Cell(3, size, repr, seed) for seed in (0, 4)]
    together = train(cells, 3, "cpu")
    for cell, (policy, points) in zip(cells, together, strict=True):
        ((alone, expected),) = train([cell], 3, "cpu")
        for size_, error in expected[-1].errors.items():
            assert points[-1].errors[size_] == pytest.approx(error, rel=1e-4)
        for (name, one), two in zip(alone.named_parameters(), policy.parameters(), strict=True):
            torch.testing.assert_close(two, one, rtol=1e-3, atol=1e-5, msg=name)
