"""NumPy's own arithmetic inside compiled code, to the last bit.

NumPy's tan, arctan, arcsin, arctan2 and power are SIMD code that differs from libm in the last bit
for some inputs, so the kernels call NumPy's own inner loops, by address. ``np.dot`` and ``@`` go
through BLAS, which on some processors fuses the second product into the sum; ``measure`` finds out
which, by comparing, and everything is compared again before the first use.
"""

from __future__ import annotations

import ctypes
import math
from itertools import product
from typing import Any

import llvmlite.ir as ir
import numpy as np
from highway_env import utils
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic as numba_intrinsic

from esc_gym.fastsim.records import Numerics

_INNER: Any = {"error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
# Inlined: a call would pass every array of the scene anew, which costs more than most of these do.
compiled: Any = njit(forceinline=True, **_INNER)
# A call, for what is long and rarely needed: inlined, it would only take long to compile.
outlined: Any = njit(**_INNER)
# Part of its only caller: one function less for LLVM to optimise on its own first.
merged: Any = njit(inline="always", **_INNER)
FUNCTIONS = ("sin", "cos", "tan", "arcsin", "arctan", "arctan2", "power")
# How a0*b0 + a1*b1 may be rounded: both products, the first one only, the second one only.
PLAIN, FUSED_SECOND, FUSED_FIRST = range(3)

# Their first argument is Numba's, and none of the caller's.
intrinsic: Any = numba_intrinsic

_DOUBLE, _INT64, _BYTE = ir.DoubleType(), ir.IntType(64), ir.IntType(8)
_POINTER = _BYTE.as_pointer()


def _call_loop(builder: Any, address: Any, data: Any, operands: list) -> Any:
    """IR of one call of a PyUFuncGenericFunction on single numbers."""
    count = len(operands) + 1
    numbers = cgutils.alloca_once(builder, _DOUBLE, size=count)
    pointers = cgutils.alloca_once(builder, _POINTER, size=count)
    sizes = cgutils.alloca_once(builder, _INT64)
    # NumPy passes strides of zero for scalars; power has fast paths that depend on it.
    strides = cgutils.alloca_once(builder, _INT64, size=count)
    builder.store(_INT64(1), sizes)
    for position in range(count):
        place = builder.gep(numbers, [_INT64(position)])
        if position < len(operands):
            builder.store(operands[position], place)
        builder.store(builder.bitcast(place, _POINTER), builder.gep(pointers, [_INT64(position)]))
        builder.store(_INT64(0), builder.gep(strides, [_INT64(position)]))
    shape = [_POINTER.as_pointer(), _INT64.as_pointer(), _INT64.as_pointer(), _POINTER]
    function = builder.inttoptr(address, ir.FunctionType(ir.VoidType(), shape).as_pointer())
    builder.call(function, [pointers, sizes, strides, builder.inttoptr(data, _POINTER)])
    return builder.load(builder.gep(numbers, [_INT64(count - 1)]))


@intrinsic
def unary(typing_context, address, data, x):
    """f(x) by the NumPy loop at ``address``."""

    def generate(context, builder, signature, arguments):
        return _call_loop(builder, arguments[0], arguments[1], [arguments[2]])

    return types.float64(types.int64, types.int64, types.float64), generate


@intrinsic
def binary(typing_context, address, data, x, y):
    """f(x, y) by the NumPy loop at ``address``."""

    def generate(context, builder, signature, arguments):
        return _call_loop(builder, arguments[0], arguments[1], [arguments[2], arguments[3]])

    return types.float64(types.int64, types.int64, types.float64, types.float64), generate


@intrinsic
def libm(typing_context, address, x, y):
    """f(x, y) by a C function: what ``**`` between two floats calls."""

    def generate(context, builder, signature, arguments):
        shape = ir.FunctionType(_DOUBLE, [_DOUBLE, _DOUBLE]).as_pointer()
        return builder.call(builder.inttoptr(arguments[0], shape), arguments[1:])

    return types.float64(types.int64, types.float64, types.float64), generate


@intrinsic
def libm_of(typing_context, address, x):
    """f(x) by a C function: what Python's ``math`` calls."""

    def generate(context, builder, signature, arguments):
        shape = ir.FunctionType(_DOUBLE, [_DOUBLE]).as_pointer()
        return builder.call(builder.inttoptr(arguments[0], shape), arguments[1:])

    return types.float64(types.int64, types.float64), generate


@intrinsic
def fused(typing_context, x, y, z):
    """x * y + z, rounded once."""

    def generate(context, builder, signature, arguments):
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), generate


@intrinsic
def borrowed(typing_context, array):
    """The same array, not counted as a reference: counting costs more than most of the kernels."""

    def generate(context, builder, signature, arguments):
        view = context.make_array(signature.args[0])(context, builder, arguments[0])
        view.meminfo = cgutils.get_null_value(view.meminfo.type)
        view.parent = cgutils.get_null_value(view.parent.type)
        return view._getvalue()

    return array(array), generate


# sin, tan, arcsin and arctan of a zero are that zero. Vehicles that keep their lane ask for little
# else, and this costs less than the call.


@compiled
def sin(np_, x):
    """``np.sin``."""
    return x if x == 0.0 else unary(np_.sin, np_.sin_data, x)


@compiled
def cos(np_, x):
    """``np.cos``."""
    return 1.0 if x == 0.0 else unary(np_.cos, np_.cos_data, x)


@compiled
def tan(np_, x):
    """``np.tan``."""
    return x if x == 0.0 else unary(np_.tan, np_.tan_data, x)


@compiled
def arcsin(np_, x):
    """``np.arcsin``."""
    return x if x == 0.0 else unary(np_.arcsin, np_.arcsin_data, x)


@compiled
def arctan(np_, x):
    """``np.arctan``."""
    return x if x == 0.0 else unary(np_.arctan, np_.arctan_data, x)


@compiled
def arctan2(np_, y, x):
    """``np.arctan2``."""
    return binary(np_.arctan2, np_.arctan2_data, y, x)


@compiled
def power(np_, x, exponent):
    """``np.power``."""
    return binary(np_.power, np_.power_data, x, exponent)


@compiled
def square(np_, x):
    """``np.power(x, 2)``, which newer NumPys multiply."""
    return x * x if np_.multiplies else binary(np_.power, np_.power_data, x, 2.0)


@compiled
def dot(rounding, a0, a1, b0, b1):
    """a0*b0 + a1*b1 as BLAS rounds it; BLAS adds to +0.0, which makes -0.0 positive."""
    if rounding == FUSED_SECOND:
        return fused(a1, b1, a0 * b0) + 0.0
    if rounding == FUSED_FIRST:
        return fused(a0, b0, a1 * b1) + 0.0
    return a0 * b0 + a1 * b1 + 0.0


@compiled
def dot3(rounding, a0, a1, a2, b0, b1, b2):
    """A dot product of three, left to right."""
    if rounding == FUSED_SECOND:
        return fused(a2, b2, fused(a1, b1, a0 * b0)) + 0.0
    return dot(rounding, a0, a1, b0, b1) + a2 * b2


@compiled
def wrap_to_pi(x):
    """``utils.wrap_to_pi``; the remainder is skipped where it changes nothing."""
    shifted = x + np.pi
    if shifted >= 0.0 and shifted < 2 * np.pi:
        return shifted - np.pi
    return (shifted % (2 * np.pi)) - np.pi


@compiled
def not_zero(x):
    """``utils.not_zero``."""
    if abs(x) > 1e-2:
        return x
    return 1e-2 if x >= 0 else -1e-2


@compiled
def clip(x, low, high):
    """``np.clip`` of a number."""
    return min(max(x, low), high)


def loop_address(function: np.ufunc) -> tuple[int, int]:
    """(address, data) of a ufunc's loop over doubles, read from the public PyUFuncObject struct."""
    index = function.types.index("d" * function.nin + "->d")
    # PyObject_HEAD (16 bytes), nin, nout, nargs, identity (4 ints), functions, data.
    functions, data = (ctypes.c_void_p.from_address(id(function) + at).value for at in (32, 40))
    size = ctypes.sizeof(ctypes.c_void_p)
    address = ctypes.c_void_p.from_address((functions or 0) + size * index).value or 0
    extra = ctypes.c_void_p.from_address(data + size * index).value if data else 0
    return address, extra or 0


def _libm(name: str) -> int:
    return ctypes.cast(getattr(ctypes.CDLL(None), name), ctypes.c_void_p).value or 0


def _loops() -> dict[str, int]:
    loops = {}
    for name in FUNCTIONS:
        loops[name], loops[f"{name}_data"] = loop_address(getattr(np, name))
    numbers = np.random.default_rng(1).uniform(-100.0, 100.0, 5000)
    multiplies = all(np.power(number, 2) == number * number for number in numbers)
    libm = {f"libm_{name}": _libm(name) for name in ("pow", "sin", "cos")}
    return {**loops, **libm, "multiplies": int(multiplies)}


def measure(check: Any, count: int = 600) -> tuple[Numerics | None, str]:
    """This machine's numerics, and "" or what the kernels cannot reproduce here.

    check: the compiled ``kernel.check``, which computes what ``_truth`` computes with NumPy.
    """
    try:
        loops = _loops()
    except (ValueError, AttributeError, OSError) as error:
        return None, f"NumPy's loops cannot be found: {error}"
    inputs = _inputs(count)
    truth = _truth(inputs)
    edges = np.cumsum([0, *WIDTHS.values()]).tolist()
    found: dict[tuple[str, ...], int] = {}
    wrong: set[str] = set()
    for rounding in (PLAIN, FUSED_SECOND, FUSED_FIRST):
        numerics = Numerics(**loops, dot=rounding, matrix_vector=rounding, matrix_matrix=rounding)
        output = np.empty_like(truth)
        check(np.array(numerics, dtype=np.int64), inputs, output)
        # As integers: 0.0 and -0.0 are different here.
        equal = (output.view(np.int64) == truth.view(np.int64)).all(axis=0)
        spans = zip(WIDTHS, edges[:-1], edges[1:], strict=True)
        wrong = {name for name, low, high in spans if not equal[low:high].all()}
        for group in ROUNDED:
            if wrong.isdisjoint(group):
                found.setdefault(group, rounding)
    wrong = wrong.difference(*ROUNDED).union(*(group for group in ROUNDED if group not in found))
    if wrong:
        return None, f"this machine's NumPy rounds otherwise in {', '.join(sorted(wrong))}"
    dot, matrix_vector, matrix_matrix = (found[group] for group in ROUNDED)
    return Numerics(**loops, dot=dot, matrix_vector=matrix_vector, matrix_matrix=matrix_matrix), ""


# What is compared, and how many numbers each gives; the groups depend on how products are rounded.
WIDTHS = {
    **dict.fromkeys(FUNCTIONS, 1),
    "square": 1, "python_square": 1, "python_sin": 1, "python_cos": 1, "wrap_to_pi": 1,
    "dot": 1, "dot3": 1, "norm": 1, "matrix_vector": 2, "polygon": 8, "corners": 18,
}  # fmt: skip
ROUNDED = (("dot", "dot3", "norm"), ("matrix_vector",), ("polygon", "corners"))


def _inputs(count: int) -> np.ndarray:
    """[count, 5]: an angle, a number in [-1, 1], a position, an exponent near 4.

    The first rows have zeros of both signs in all combinations.
    """
    rng = np.random.default_rng(0)
    inputs = rng.uniform(-1.0, 1.0, (count, 5)) * [7.0, 1.0, 100.0, 30.0, 0.5] + [0, 0, 0, 0, 4.0]
    zeros = list(product((0.0, -0.0, 0.5, -0.5), repeat=4))
    inputs[: len(zeros), :4] = zeros
    return inputs


def _truth(inputs: np.ndarray) -> np.ndarray:
    """What NumPy, called as highway-env calls it, makes of the inputs: [count, sum of WIDTHS]."""
    rows = []
    for angle, part, x, y, exponent in inputs.tolist():
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.array([[c, -s], [s, c]])
        vector = np.array([x, y])
        turned = rotation.dot(vector)
        # The dynamic bicycle writes the same product with `@`, and `**` of either float type.
        same = (turned == np.array(((c, -s), (s, c))) @ np.array([x, y])).all()
        polygon = utils.rect_corners(np.zeros(2), x, y, angle)
        corners = utils.rect_corners(
            np.zeros(2), x, y, angle, include_midpoints=True, include_center=True
        )
        rows.append([
            s, c, np.tan(angle), np.arcsin(part), np.arctan(x), np.arctan2(x, y),
            np.power(abs(y), exponent), np.power(x, 2),
            x**2 if x**2 == np.float64(x) ** 2 else np.nan,
            math.sin(angle), math.cos(angle),
            utils.wrap_to_pi(x),
            np.dot(vector, np.array([part, angle])),
            np.dot([angle, part, exponent], np.array([x, y, part])),
            np.linalg.norm(vector),
            *(turned if same else (np.nan, np.nan)),
            *np.ravel(polygon), *np.ravel(corners),
        ])  # fmt: skip
    return np.array(rows)
