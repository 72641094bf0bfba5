"""How hot loops are compiled: one place for numba's options.

A kernel is a plain function over arrays. It releases the interpreter lock, is compiled once and cached beside
its source, and has a plain NumPy form in its test.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

from scanner.kernel_cache import choose_cache

CACHED = choose_cache(Path(__file__).parent, os.environ)
"""False where no folder can hold compiled kernels: they are then compiled by every process."""

import numba  # noqa: E402  (it reads the folder's name when it is imported)

cast(Any, numba).core.config.reload_config()  # for one who imported it earlier

_F = TypeVar("_F", bound=Callable[..., Any])


def kernel(function: _F) -> _F:
    """Compile `function` for one thread, cached, without the interpreter lock."""
    return cast(_F, numba.njit(cache=CACHED, nogil=True, error_model="numpy")(function))


def contracting_kernel(function: _F) -> _F:
    """Compile `function` like `kernel`, free to multiply and add in one instruction, with one rounding for two.

    Results may differ in the last bit from one machine to another. NaN and infinity keep their meaning.
    """
    options = {"contract", "nsz"}
    return cast(_F, numba.njit(cache=CACHED, nogil=True, error_model="numpy", fastmath=options)(function))


def inlined_kernel(function: _F) -> _F:
    """Compile `function` like `contracting_kernel`, into each kernel that calls it: its vectors stay in registers.

    It must make no arrays: theirs to free are counted by nobody here.
    """
    options = {"contract", "nsz"}
    compile_ = cast(Any, numba).njit(
        cache=CACHED, nogil=True, error_model="numpy", fastmath=options, forceinline=True, _nrt=False
    )
    return cast(_F, compile_(function))


def summing_kernel(function: _F) -> _F:
    """Compile `function` like `kernel`, free to take sums in any order: a dot product then runs in vector registers.

    Results may differ in the last bits from one machine to another. NaN and infinity keep their meaning.
    """
    options = {"reassoc", "contract", "nsz"}
    return cast(_F, numba.njit(cache=CACHED, nogil=True, error_model="numpy", fastmath=options)(function))
