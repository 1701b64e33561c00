"""What all encoders keep, and what they refuse."""

import ast
import math
import sys
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings, strategies as st
from torch.func import functional_call, stack_module_state, vmap

from esc_gym import encoders, sets
from esc_gym.encoders import (
    REPRESENTATIONS,
    ESCEncoder,
    FPEncoder,
    SetEncoder,
    representation,
)
from tests.esc_gym.encoding import (
    D1,
    D2,
    DIMS,
    NAMES,
    POOLING,
    TOLERANCE,
    N,
    build,
    gradients,
    scene,
    scenes,
)  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
@given(scenes, st.permutations(range(N)))
@settings(max_examples=25, deadline=None)
def test_permuted_rows_leave_the_output_as_declared(name, drawn, order):
    seed, counts = drawn
    encoder, (vehicles, mask, ego) = build(name), scene(counts, seed)
    output = encoder(vehicles, mask, ego)
    permuted = encoder(vehicles[:, order], mask[:, order], ego)
    real = [[i for i in order if mask[b, i]] for b in range(len(counts))]
    for b, rows in enumerate(real):
        same = torch.allclose(permuted[b], output[b], **TOLERANCE)
        assert same == (encoder.permutation_invariant or rows == sorted(rows))


@pytest.mark.parametrize("garbage", [7.0, 1e30, math.inf, math.nan])
@pytest.mark.parametrize("name", NAMES)
def test_padding_reaches_neither_outputs_nor_gradients(name, garbage):
    encoder, (vehicles, mask, ego) = build(name), scene([0, 1, 3, N])
    dirty = vehicles.masked_fill(mask[:, :, None] == 0, garbage)
    clean, dirty = vehicles.requires_grad_(), dirty.requires_grad_()
    expected, output = encoder(clean, mask, ego), encoder(dirty, mask, ego)
    torch.testing.assert_close(output, expected, rtol=0, atol=0)
    torch.testing.assert_close(gradients(encoder, output), gradients(encoder, expected))
    expected.sum().backward()
    output.sum().backward()
    assert dirty.grad is not None
    assert dirty.grad[mask == 0].eq(0).all()
    assert dirty.grad[mask == 1].ne(0).any()
    torch.testing.assert_close(dirty.grad, clean.grad)


@pytest.mark.parametrize("counts", [[], [0], [0, 0, 0], [0, 2, 0]])
@pytest.mark.parametrize("name", NAMES)
def test_empty_sets(name, counts):
    encoder, (vehicles, mask, ego) = build(name), scene(counts)
    output = encoder(vehicles, mask, ego)
    assert output.shape == (len(counts), N * D1 + 1 + D2)
    torch.testing.assert_close(output[:, -D2:], ego, rtol=0, atol=0)
    for b, count in enumerate(counts):
        if count == 0 and name in POOLING:
            assert output[b, :-D2].eq(0).all()
    assert all(g.isfinite().all() for g in gradients(encoder, output).values())


@pytest.mark.parametrize("dtype", [torch.bool, torch.int8, torch.int64, torch.float32])
@pytest.mark.parametrize("name", NAMES)
def test_masks_of_any_dtype(name, dtype):
    encoder, (vehicles, mask, ego) = build(name), scene([2, 5])
    torch.testing.assert_close(
        encoder(vehicles, mask.to(dtype), ego), encoder(vehicles, mask, ego), rtol=0, atol=0
    )


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("index", "tensor", "message"),
    [
        (0, torch.zeros(2, N, D1 + 1), r"vehicles: expected shape \(2, 6, 3\), got \(2, 6, 4\)"),
        (0, torch.zeros(N, D1), r"vehicles: expected shape \(2, 6, 3\), got \(6, 3\)"),
        (1, torch.zeros(2, N, 1), r"expected shape \(B, N, 3\)|mask: expected shape \(B, N\)"),
        (1, torch.zeros(3, N), r"vehicles: expected shape \(3, 6, 3\), got \(2, 6, 3\)"),
        (2, torch.zeros(2, D2 + 1), r"ego: expected shape \(2, 2\), got \(2, 3\)"),
        (0, torch.zeros(2, N, D1, dtype=torch.float64), "vehicles: expected dtype torch.float32"),
        (2, torch.zeros(2, D2, dtype=torch.long), "ego: expected dtype torch.float32"),
    ],
)
def test_wrong_tensors_are_refused(name, index, tensor, message):
    inputs = list(scene([1, 2]))
    inputs[index] = tensor
    with pytest.raises(ValueError, match=message):
        build(name)(*inputs)


@pytest.mark.parametrize(
    ("name", "kwargs", "message"),
    [
        ("esc", {"vehicle_dim": 0}, r"vehicle_dim: expected an integer >= 1, got 0"),
        ("esc", {"ego_dim": 2.5}, "ego_dim"),
        ("esc", {"max_vehicles": None}, "max_vehicles"),
        ("esc", {"code_dim": -1}, "code_dim"),
        ("esc", {"hidden": ()}, "hidden: expected at least one"),
        ("esc", {"hidden": (8, 0)}, r"hidden\[1\]"),
        *(
            ("esc", {"scale": wrong}, "scale: expected a finite number other than 0")
            for wrong in (0.0, math.nan, math.inf, "1e-1", True, None)
        ),
        ("attention", {"heads": 0}, "heads"),
        *(
            ("esc-exp", {"sharpness": wrong}, "sharpness: expected a number from 0.001 to 1e6")
            for wrong in (0.0, -1.0, math.inf, math.nan, 1e-4, 1e30, 10**400, "1e3", True, None)
        ),
        ("fp", {"slots": 0}, "slots"),
        ("fp", {"sort": "size"}, "sort: expected one of distance, lexicographic, got 'size'"),
        ("fp", {"position": (0, 3)}, "position: expected two of 3 columns"),
        ("ap", {"high": [1.0]}, "low, high"),
        ("ap", {"high": [1.0, 0.0, 1.0]}, "low, high"),
    ],
)
def test_wrong_settings_are_refused(name, kwargs, message):
    with pytest.raises(ValueError, match=message):
        build(name, **kwargs)


def test_unknown_settings_are_refused():
    with pytest.raises(TypeError, match=r"Encoder takes heads, hidden, .*scale; got sharpness, z$"):
        build("attention", sharpness=1, heads=1, z=3)


def test_what_encoders_of_others_take_is_said():
    class Plain(ESCEncoder):
        pass

    class Powers(Plain):
        def __init__(self, power=2.0, **dims):
            super().__init__(**dims)

    dims = {"vehicle_dim": 3, "ego_dim": 2, "max_vehicles": 4}
    with pytest.raises(TypeError, match=r"^Plain takes hidden, code_dim, scale; got powr$"):
        Plain(**dims, powr=1)
    with pytest.raises(TypeError, match=r"^Powers takes power, hidden, code_dim, scale; got powr$"):
        Powers(**dims, powr=1)


def test_representation_by_name_and_by_path():
    assert representation("esc") is ESCEncoder
    assert representation("esc_gym.encoders:FPEncoder") is FPEncoder


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "atention",
            r"expected one of esc, esc-exp, fp, ap, mean, max, attention.*did you mean 'attention'",
        ),
        ("nonsense", r"unknown representation 'nonsense'"),
        ("no_such_module:Encoder", "no_such_module"),
        ("esc_gym.encoders:NoEncoder", "NoEncoder"),
        ("math:pi", "subclass of SetEncoder"),
        (":ESCEncoder", "Empty module name"),
        (".relative:Encoder", "relative"),
    ],
)
def test_unknown_representations_are_refused(name, message):
    with pytest.raises(ValueError, match=message):
        representation(name)


def test_a_new_representation_is_one_class():
    class Count(SetEncoder):
        def encode(self, vehicles, mask, ego):
            return mask.sum(dim=1, keepdim=True).to(ego.dtype).expand(-1, self.code_dim)

    vehicles, mask, ego = scene([0, 4])
    assert Count(**DIMS, code_dim=1)(vehicles, mask, ego)[:, 0].tolist() == [0, 4]
    with pytest.raises(NotImplementedError, match="has to define encode"):
        SetEncoder(**DIMS)(vehicles, mask, ego)


MODULES = [*Path(encoders.__path__[0]).glob("*.py"), Path(sets.__file__)]


@pytest.mark.parametrize("module", MODULES, ids=lambda path: path.stem)
def test_encoders_need_neither_sb3_nor_gymnasium_of_their_own(module):
    """They import torch, each other and the standard library only."""
    found = set()
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module)
    others = {name for name in found if name.split(".")[0] not in sys.stdlib_module_names}
    others = {name for name in others if not name.startswith("esc_gym.encoders.")}
    assert others <= {"torch", "torch.nn", "esc_gym.sets"}


def test_double_precision_and_state_dict():
    encoder, (vehicles, mask, ego) = build("fp", high=[1.0, 0.5, 1.0]).double(), scene([3])
    assert encoder(vehicles.double(), mask, ego.double()).dtype == torch.float64
    assert all(name.startswith(("layers.", "output.")) for name in encoder.state_dict())


def test_declarations():
    assert {name for name in NAMES if not REPRESENTATIONS[name].permutation_invariant} == {"ap"}
    assert {name for name in NAMES if not build(name).any_size} == {"ap", "fp"}


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_without_padding_a_mask_is_not_needed(name):
    encoder = REPRESENTATIONS[name](vehicle_dim=3, ego_dim=2, max_vehicles=4, hidden=(8,))
    vehicles, ego = torch.randn(5, 4, 3), torch.randn(5, 2)
    expected = encoder(vehicles, torch.ones(5, 4), ego)
    torch.testing.assert_close(encoder(vehicles, None, ego), expected, rtol=1e-5, atol=1e-6)
    repeated = torch.zeros(()).expand(5, 4)  # a padded mask that is one number, too
    assert not torch.equal(encoder(vehicles, repeated, ego), expected)
    with pytest.raises(ValueError, match="vehicles: expected shape"):
        encoder(vehicles[:, :, :2], None, ego)


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_many_encoders_at_once(name):
    """torch.func.vmap over weights, for which no shape may depend on values."""
    make = REPRESENTATIONS[name]
    encoders = [make(vehicle_dim=3, ego_dim=2, max_vehicles=4, hidden=(8,)) for _ in range(3)]
    vehicles, ego = torch.randn(3, 5, 4, 3), torch.randn(3, 5, 2)
    parameters, buffers = stack_module_state(encoders)

    def one(parameters, buffers, vehicles, ego):
        return functional_call(encoders[0], (parameters, buffers), (vehicles, None, ego))

    together = vmap(one)(parameters, buffers, vehicles, ego)
    alone = [e(v, None, x) for e, v, x in zip(encoders, vehicles, ego, strict=True)]
    torch.testing.assert_close(together, torch.stack(alone), rtol=1e-4, atol=1e-5)
