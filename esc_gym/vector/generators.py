"""NumPy's generator inside compiled code: PCG64, and the draws that highway-env's resets make.

A generator is a row of 6 unsigned integers: state (high, low), increment (high, low), and the half
of a 64-bit number that a 32-bit draw left over (is there one, which). Same stream, same order, same
bits as ``numpy.random.Generator(PCG64)``.
"""

from __future__ import annotations

from importlib import import_module
from math import exp, log1p
from typing import Any

import numpy as np

from esc_gym.fastsim.numerics import compiled, outlined

SIZE = 6
_LOW = (1 << 64) - 1
# PCG_DEFAULT_MULTIPLIER_128 of pcg64.h.
_FACTOR_HIGH, _FACTOR_LOW = np.uint64(2549297995355413924), np.uint64(4865540595714422341)
# Tables of NumPy's ziggurat, which Numba has, too.
ziggurat: Any = import_module("numba.np.random._constants")
_WIDTH, _KEEP, _HEIGHT = ziggurat.wi_double, ziggurat.ki_double, ziggurat.fi_double
_TAIL, _INVERSE = ziggurat.ziggurat_nor_r, ziggurat.ziggurat_nor_inv_r
_HALF, _SHIFT = np.uint64(0xFFFFFFFF), np.uint64(32)


def row(generator: np.random.Generator) -> np.ndarray:
    """The present state of a NumPy generator, uint64 [6]. Raises TypeError unless it is PCG64."""
    state: Any = generator.bit_generator.state
    if state["bit_generator"] != "PCG64":
        raise TypeError(f"expected a PCG64 generator, got {state['bit_generator']}")
    numbers = [part for name in ("state", "inc") for part in divmod(state["state"][name], 1 << 64)]
    return np.array([*numbers, state["has_uint32"], state["uinteger"]], np.uint64)


def generator(numbers: np.ndarray) -> np.random.Generator:
    """A NumPy generator that goes on where the row is."""
    bits = np.random.PCG64(0)
    high, low, inc_high, inc_low, has, left = (int(number) for number in numbers)
    bits.state = {
        "bit_generator": "PCG64",
        "state": {"state": high << 64 | low, "inc": inc_high << 64 | inc_low},
        "has_uint32": has,
        "uinteger": left,
    }
    return np.random.Generator(bits)


@compiled
def _product_high(a, b):
    """The upper 64 of the 128 bits of a * b."""
    a_high, a_low, b_high, b_low = a >> _SHIFT, a & _HALF, b >> _SHIFT, b & _HALF
    middle = a_high * b_low + ((a_low * b_low) >> _SHIFT)
    other = a_low * b_high + (middle & _HALF)
    return a_high * b_high + (middle >> _SHIFT) + (other >> _SHIFT)


@outlined
def next64(g):
    """64 random bits (``pcg64_next64``: step, then XSL-RR)."""
    high, low = g[0], g[1]
    stepped = low * _FACTOR_LOW
    carried = _product_high(low, _FACTOR_LOW) + high * _FACTOR_LOW + low * _FACTOR_HIGH
    low = stepped + g[3]
    high = carried + g[2] + np.uint64(low < stepped)
    g[0], g[1] = high, low
    turn = high >> np.uint64(58)
    mixed = high ^ low
    return (mixed >> turn) | (mixed << ((np.uint64(64) - turn) & np.uint64(63)))


@compiled
def next32(g):
    """32 random bits: half of a 64-bit number; the other half is kept for the next call."""
    if g[4] != np.uint64(0):
        g[4] = np.uint64(0)
        return g[5]
    number = next64(g)
    g[4], g[5] = np.uint64(1), number >> _SHIFT
    return number & _HALF


@outlined
def below(g, count):
    """``integers(0, count)``, which is also ``choice(count)``, for counts up to 2**32 - 1."""
    if count <= 1:
        return 0
    size = np.uint64(count)
    product = next32(g) * size
    left = product & _HALF
    if left < size:
        threshold = (_HALF - (size - np.uint64(1))) % size
        while left < threshold:
            product = next32(g) * size
            left = product & _HALF
    return np.int64(product >> _SHIFT)


@compiled
def random(g):
    """``random()``: uniform in [0, 1)."""
    return np.float64(next64(g) >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@compiled
def uniform(g, low, high):
    """``uniform(low, high)``."""
    return low + (high - low) * random(g)


@outlined
def normal(g):
    """``normal()`` (``random_standard_normal``)."""
    while True:
        r = next64(g)
        index = np.int64(r & np.uint64(0xFF))
        size = (r >> np.uint64(9)) & np.uint64(0x000FFFFFFFFFFFFF)
        x = np.float64(size) * _WIDTH[index]
        if (r >> np.uint64(8)) & np.uint64(1):
            x = -x
        if size < _KEEP[index]:
            return x
        if index > 0:
            low, high = _HEIGHT[index], _HEIGHT[index - 1]
            if (high - low) * random(g) + low < exp(-0.5 * x * x):
                return x
            continue
        while True:
            beyond = -_INVERSE * log1p(-random(g))
            y = -log1p(-random(g))
            if y + y > beyond * beyond:
                far = _TAIL + beyond
                return -far if (size >> np.uint64(8)) & np.uint64(1) else far


@outlined
def shuffle(g, items, count):
    """``permutation`` of the first ``count`` of ``items``, in place (``random_interval``)."""
    for i in range(count - 1, 0, -1):
        mask = np.uint64(i)
        for half in (1, 2, 4, 8, 16):
            mask |= mask >> np.uint64(half)
        j = next32(g) & mask
        while j > np.uint64(i):
            j = next32(g) & mask
        items[i], items[j] = items[j], items[i]
