"""Four samples of a pixel side by side: what is made of four frames of bytes by one instruction.

Each sum of samples times weights is one step for all four then, straight into whole numbers, where samples by
themselves are widened first. For kernels, and for machines that have the instruction: `has_quads` says so when a kernel
is compiled; what a kernel does in quads it has to have another way of doing, too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numpy.typing import NDArray

from scanner.lanes import LANES, WHOLE, Lanes, LanesType, address_of, in_lanes, intrinsic

_FRAMES = 4
_REGISTER = 16
"""Pixels of one instruction."""
_NEEDED = ("avx512vnni", "avx512vbmi")
"""Features of a processor: dot products of bytes, and to bring bytes of two registers into any order."""

_BYTE, _INT = ir.IntType(8), ir.IntType(32)
_QUADS = LanesType("quads", _BYTE, None, _FRAMES)
_insert: Any = cast(Any, cgutils).get_or_insert_function  # Numba has no type hints


def weights_of(*four: int) -> np.int32:
    """Weights of four samples, -128 .. 127, as `dot` takes them."""
    return cast(np.int32, np.array(four, np.int8).view(np.int32)[0])


def _constant(kind: Any, value: int) -> Any:
    return ir.Constant(kind, [value] * kind.count)


def _shuffled(builder: Any, a: Any, b: Any, order: list[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INT, len(order)), order))


def _joined(builder: Any, a: Any, b: Any) -> Any:
    return _shuffled(builder, a, b, list(range(2 * a.type.count)))


def _halves(builder: Any, value: Any) -> list[Any]:
    size = value.type.count // 2
    return [_shuffled(builder, value, value, list(range(at, at + size))) for at in (0, size)]


def _has_quads(context: Any, like: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        _, _, features = context.codegen().magic_tuple()
        fits = like.dtype.bitwidth == 8 and all(f"+{name}" in features.split(",") for name in _NEEDED)
        return ir.Constant(ir.IntType(1), int(fits))

    return types.boolean(like), generate


has_quads: Callable[[NDArray[Any]], bool] = intrinsic(_has_quads)
"""has_quads(like): whether frames of that dtype are to be worked on in quads, on the machine that is compiled for."""


def _quads(context: Any, addresses: Any, frame: Any, pixel: Any, like: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        if like.dtype.bitwidth != 8:
            return ir.Constant(_QUADS.vector, ir.Undefined)
        row, (table, first, at, frames) = ir.VectorType(_BYTE, LANES), values
        rows = []
        for n in range(_FRAMES):
            number = builder.add(first, ir.Constant(first.type, n))
            place = address_of(context, builder, signature, (table, number, at, frames))
            rows.append(builder.load(builder.inttoptr(place, row.as_pointer()), align=1))
        two, more = _joined(builder, *rows[:2]), _joined(builder, *rows[2:])
        order = [LANES * n + i for i in range(LANES) for n in range(_FRAMES)]
        half = len(order) // 2
        return _joined(builder, *(_shuffled(builder, two, more, part) for part in (order[:half], order[half:])))

    return _QUADS(addresses, types.intp, types.intp, like), generate


quads: Callable[[NDArray[Any], int, int, NDArray[Any]], Lanes] = intrinsic(_quads)
"""quads(addresses, n, pixel, like): samples of frames n .. n + 3 from a pixel on; see `scanner.decode.addresses`."""


def _no_quads(context: Any) -> Any:
    return _QUADS(), lambda context, builder, signature, values: _constant(_QUADS.vector, 0)


no_quads: Callable[[], Lanes] = intrinsic(_no_quads)
"""Four samples of 0 each."""


def _dotted(context: Any, builder: Any, samples: Any, weights: Any, total: Any) -> Any:
    _, _, features = context.codegen().magic_tuple()
    if any(f"+{name}" not in features.split(",") for name in _NEEDED):
        return total  # never run: `has_quads`
    words = ir.VectorType(_INT, _REGISTER)
    function = _insert(builder.module, ir.FunctionType(words, [words] * 3), "llvm.x86.avx512.vpdpbusd.512")
    samples, weights = (builder.bitcast(v, WHOLE.vector) for v in (samples, weights))
    parts = zip(*(_halves(builder, v) for v in (total, samples, weights)), strict=True)
    return _joined(builder, *(builder.call(function, part) for part in parts))


def _dot(context: Any, samples: Any, weights: Any, total: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        found = (in_lanes(context, builder, v, t, WHOLE) for v, t in zip(values[1:], signature.args[1:], strict=True))
        return _dotted(context, builder, values[0], *found)

    return (WHOLE(samples, weights, total), generate) if samples is _QUADS else None


dot: Callable[[Lanes, Any, Any], Lanes] = intrinsic(_dot)
"""dot(quads, weights, total): total + each pixel's four samples times their weights (`weights_of`)."""


def _energy(context: Any, samples: Any, total: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        from_middle = builder.xor(values[0], _constant(_QUADS.vector, 128))
        total = in_lanes(context, builder, values[1], signature.args[1], WHOLE)
        return _dotted(context, builder, values[0], from_middle, total)

    return (WHOLE(samples, total), generate) if samples is _QUADS else None


energy: Callable[[Lanes, Any], Lanes] = intrinsic(_energy)
"""energy(quads, total): total + x (x - 128) of each pixel's four samples x."""


def _brighter(context: Any, a: Any, b: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.select(builder.icmp_unsigned(">", *values), *values)

    return (_QUADS(a, b), generate) if a is _QUADS and b is _QUADS else None


brighter: Callable[[Lanes, Lanes], Lanes] = intrinsic(_brighter)
"""The brighter of each two samples."""


def _brightest(context: Any, samples: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        found = values[0]
        for bits in (16, 8):
            others = builder.lshr(builder.bitcast(found, WHOLE.vector), _constant(WHOLE.vector, bits))
            others = builder.bitcast(others, _QUADS.vector)
            found = builder.select(builder.icmp_unsigned(">", found, others), found, others)
        return builder.and_(builder.bitcast(found, WHOLE.vector), _constant(WHOLE.vector, 255))

    return (WHOLE(samples), generate) if samples is _QUADS else None


brightest: Callable[[Lanes], Lanes] = intrinsic(_brightest)
"""The brightest of each pixel's four samples, as whole numbers."""


def _any_reaches(context: Any, samples: Any, level: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        level = context.cast(builder, values[1], signature.args[1], types.int32)
        most = ir.Constant(_INT, 255)
        level = builder.select(builder.icmp_signed("<", level, most), level, most)
        first = builder.insert_element(
            ir.Constant(_QUADS.vector, ir.Undefined), builder.trunc(level, _BYTE), ir.Constant(_INT, 0)
        )
        levels = _shuffled(builder, first, first, [0] * _QUADS.vector.count)
        bits = ir.IntType(_QUADS.vector.count)
        there = builder.bitcast(builder.icmp_unsigned(">=", values[0], levels), bits)
        return builder.icmp_unsigned("!=", there, ir.Constant(bits, 0))

    return (types.boolean(samples, level), generate) if samples is _QUADS and isinstance(level, types.Integer) else None


any_reaches: Callable[[Lanes, int], bool] = intrinsic(_any_reaches)
"""Whether any sample is as bright as a level of 0 or more; where the level is above 255, whether any is 255."""
