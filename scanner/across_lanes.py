"""What takes all lanes of a vector together: sums, the greatest, and masks as words of bits.

Beside `scanner.lanes`, whose operations go lane by lane, and in compiled code only as those. A kernel that finds few
lanes worth the work asks a mask for its bits and takes them one by one, without a branch for each lane.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils

from scanner.lanes import FLOATS, LANES, MASK, Lanes, intrinsic

_WORD = ir.IntType(64)
_insert: Any = cast(Any, cgutils).get_or_insert_function  # Numba has no type hints


def _reduced(name: str, free: tuple[str, ...], first: float | None) -> Callable[[Lanes], Any]:
    """One of LLVM's reductions; `free` says what it may do to be done in few steps."""

    def one(context: Any, x: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            begin = [] if first is None else [ir.Constant(ir.FloatType(), first)]
            kind = ir.FunctionType(ir.FloatType(), [ir.FloatType()] * len(begin) + [FLOATS.vector])
            function = _insert(builder.module, kind, f"llvm.vector.reduce.{name}.v{LANES}f32")
            return builder.call(function, [*begin, values[0]], fastmath=free)

        return (types.float32(x), generate) if x is FLOATS else None

    return cast(Callable[[Lanes], Any], intrinsic(one))


total_of = _reduced("fadd", ("reassoc", "nsz"), -0.0)
"""The sum of all lanes, in an order of the machine's."""
greatest_of = _reduced("fmax", ("nnan", "nsz"), None)
"""The greatest of all lanes, of which none is NaN."""


def _bits_of(context: Any, mask: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.zext(builder.bitcast(values[0], ir.IntType(LANES)), _WORD)

    return (types.uint64(mask), generate) if mask is MASK else None


bits_of: Callable[[Any], Any] = intrinsic(_bits_of)
"""A mask as a word of 64 bits: bit n is lane n."""


def _lowest(context: Any, bits: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.cttz(values[0], ir.Constant(ir.IntType(1), 1))

    return (types.int64(bits), generate) if bits == types.uint64 else None


lowest: Callable[[Any], int] = intrinsic(_lowest)
"""Number of the lowest bit that is set in a word of which one is."""
