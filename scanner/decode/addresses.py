"""Frames by address: how one kernel reads pixels that lie in several arrays, or in the map of a file.

Numba compiles a tuple of arrays anew for every number of frames, and copying the frames into one array would cost as
much as decoding them. Whoever makes a table of addresses keeps the frames alive and unchanged while it is in use.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from scanner.kernel import kernel

CACHE_LINE = 64
PAGE = 4096

_carray = cast(Any, numba).carray
_compiler = cast(Any, cgutils)


def addresses_of(frames: Sequence[NDArray[Any]]) -> NDArray[np.intp]:
    """(F,) where each frame's first pixel lies.

    Raises:
        ValueError: a frame is not one block of memory.
    """
    if any(not frame.flags.c_contiguous for frame in frames):
        raise ValueError("a frame without gaps is needed")
    return np.array([_address_of(frame) for frame in frames], dtype=np.intp)


@kernel
def _address_of(frame: NDArray[Any]) -> int:
    # A sixth of the time of `frame.ctypes.data`, which makes an object.
    return frame.ctypes.data


def warm_up() -> None:
    """Compile what tells addresses of frames in memory, and in the map of a file that nobody writes into."""
    for dtype in (np.uint8, np.uint16):
        frame = np.zeros((1, 1), dtype)
        addresses_of([frame])
        frame.flags.writeable = False
        addresses_of([frame])


@kernel
def pixels_at(address: int, first: int, count: int, like: NDArray[Any]) -> NDArray[Any]:
    """Pixels first .. first + count - 1 of the frame at `address`, no copy; of the dtype of `like`. For kernels."""
    pixels: NDArray[Any] = _carray(_pointer(address + first * like.itemsize), (count,), like.dtype)
    return pixels


@kernel
def copies_of(
    addresses: NDArray[np.intp], at: int, size: int, like: NDArray[Any], spare: NDArray[Any]
) -> NDArray[np.intp]:
    """Addresses of copies of `size` pixels from `at` on, for less than a vector of them: nothing may be read beyond a
    frame's last pixel. For kernels; address 0 stays what it is.

    Args:
        spare: (F, a vector's length) that holds the copies. Numba frees an array once it was mentioned for the last
            time, and knows nothing of addresses: give it to `keep` when the copies were read.
    """
    copies = np.empty_like(addresses)
    for n in range(addresses.size):
        copies[n] = 0
        if addresses[n] != 0:
            spare[n, :size] = pixels_at(addresses[n], at, size, like)
            copies[n] = spare[n:].ctypes.data - at * like.itemsize
    return copies


@kernel
def keep(spare: NDArray[Any]) -> None:
    """Mention memory that was read by its address: until here it was not free to be given away. For kernels."""
    spare[0, 0] = 0


@kernel
def aligned_rows(rows: int, length: int) -> NDArray[np.float32]:
    """(rows, length) float32 whose rows begin with a cache line, for lengths that are multiples of 16. For kernels.

    Vector registers are as wide as a line: what lies across two of them takes twice as long to load or store.
    """
    block = np.empty(rows * length + CACHE_LINE // 4, np.float32)
    skip = (-block.ctypes.data % CACHE_LINE) // 4
    return block[skip : skip + rows * length].reshape(rows, length)


def maps_to_fill(rows: int, length: int) -> NDArray[np.float32]:
    """(rows, length) float32 of any content, in rows as `aligned_rows` has them, of memory that is there already.

    Made while frames are being exposed: the system finds the memory then, and not after the last one. One block is
    large enough for large pages, and of each page only a word is written: what is written whole has to leave the
    caches again while frames are read.
    """
    block = np.empty(rows * length + CACHE_LINE // 4, np.float32)
    block[:: PAGE // 4] = 0
    skip = (-block.ctypes.data % CACHE_LINE) // 4
    return block[skip : skip + rows * length].reshape(rows, length)


@kernel
def expect_pixels(address: int, first: int, count: int, like: NDArray[Any]) -> None:
    """Have the processor fetch pixels that will be asked for soon, while it works on others. For kernels."""
    begin = address + first * like.itemsize
    for at in range(begin, begin + count * like.itemsize, CACHE_LINE):
        _prefetch(at)


def _pointer_of_address(typing_context: Any, address: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.voidptr(types.intp), generate


_pointer: Any = cast(Any, intrinsic)(_pointer_of_address)


def _prefetch_address(typing_context: Any, address: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        # llvm.prefetch(pointer, read, to the second-level cache, data); it never faults.
        pointer, integer = _compiler.voidptr_t, ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [pointer, integer, integer, integer])
        call = _compiler.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        options = [ir.Constant(integer, value) for value in (0, 2, 1)]
        builder.call(call, [builder.inttoptr(arguments[0], pointer), *options])
        return context.get_dummy_value()

    return types.void(types.intp), generate


_prefetch: Any = cast(Any, intrinsic)(_prefetch_address)
