"""Where vectors lie: a stack that suits them, and stores of what nobody reads soon.

Beside `scanner.lanes`, which loads and stores. For kernels whose time is that of memory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numpy.typing import NDArray

from scanner.lanes import FLOATS, Lanes, intrinsic, pointer_to

_LINE = 64
"""Bytes of a cache line, and of the widest registers."""


def _align_stack(context: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        with builder.goto_entry_block():
            place = builder.alloca(FLOATS.vector)
            place.align = _LINE
        # Nothing at all is done with it; but it is there, and what else lies on the stack is aligned with it.
        kind = ir.FunctionType(ir.VoidType(), [place.type])
        builder.call(ir.InlineAsm(kind, "", "r", side_effect=True), [place])
        return context.get_dummy_value()

    return types.void(), generate


align_stack: Callable[[], None] = intrinsic(_align_stack)
"""Put the kernel's stack on whole cache lines. To be called once, first, where many vectors are alive together.

Vectors that find no register lie on the stack, which by itself begins at any multiple of 16 bytes: in three processes
of four each of them lies across two lines then, and the kernel may take half as long again."""


def _stream(context: Any, array: Any, at: Any, lanes: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        row, first, value = values
        pointer = pointer_to(context, builder, signature.args[0], row, first, value.type)
        stored = builder.store(value, pointer, align=_LINE)
        stored.set_metadata("nontemporal", builder.module.add_metadata([ir.Constant(ir.IntType(32), 1)]))
        return context.get_dummy_value()

    return (types.void(array, types.intp, lanes), generate) if lanes is FLOATS else None


stream: Callable[[NDArray[Any], int, Lanes], None] = intrinsic(_stream)
"""stream(row, at, lanes): floats into a (n,) float32 array that nobody reads soon, past the caches.

row[at] must begin a cache line (`scanner.decode.addresses.aligned_rows`): anything else ends the process."""
