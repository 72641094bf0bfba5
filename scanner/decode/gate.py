"""Words that threads share inside kernels: a gate that one opens for the others, turns that each takes once, and how
many are at work.

A thread that sleeps is woken in thirty microseconds, and by the interpreter, whose lock it needs then; one that waits
in a kernel goes on at once. So it is woken early, and waits here for what is not ready yet, for LONGEST at the most.
"""

from __future__ import annotations

import platform
from typing import Any, cast

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from scanner.decode.addresses import CACHE_LINE
from scanner.kernel import kernel

SHUT, OPEN, ABANDONED = 0, 1, 2
"""Not yet; go on; there is nothing to be done."""


_compiler = cast(Any, cgutils)
_GATE, _TURN, _BUSY = 0, CACHE_LINE // 8, 2 * CACHE_LINE // 8
"""Words that different threads write lie on lines of their own."""

_WORDS = 3 * CACHE_LINE // 8

LONGEST = 1 << 9
"""Rounds of looking at a gate before a thread goes to sleep after all: a millisecond, twice what it is shut for."""

_LOOKS = 32
"""In a round, one or two microseconds long; after it whoever else has work for this processor goes first: it may be
the one that is to open the gate."""


def new_gate() -> NDArray[np.int64]:
    """A gate that is shut, and no turn taken."""
    return np.zeros(_WORDS, np.int64)


@kernel
def set_gate(gate: NDArray[np.int64], state: int) -> None:
    """Let through who waits, OPEN, or send them away, ABANDONED: all that was written before is seen by them."""
    _store_release(gate, _GATE, np.int64(state))


@kernel
def wait_for(gate: NDArray[np.int64]) -> int:
    """The gate's state; still SHUT after LONGEST looks."""
    for _ in range(LONGEST):
        for _ in range(_LOOKS):
            state = _load_acquire(gate, _GATE)
            if state != SHUT:
                return int(state)
            _pause()
        _give_way()
    return SHUT


@kernel
def come_and_go(gate: NDArray[np.int64], more: int) -> None:
    """1: one more is at work, to be said before its first turn. -1: it has taken its last, and all is written."""
    _add(gate, _BUSY, np.int64(more))


@kernel
def all_gone(gate: NDArray[np.int64]) -> bool:
    """Whether nobody is at work, or is no more after LONGEST looks. To be asked when there is no turn left: who comes
    then has nothing to do."""
    for _ in range(LONGEST):
        for _ in range(_LOOKS):
            if _load_acquire(gate, _BUSY) == 0:
                return True
            _pause()
        _give_way()
    return False


@kernel
def next_turn(gate: NDArray[np.int64]) -> int:
    """0, 1, 2, ...: each number to one caller."""
    return int(_add(gate, _TURN, np.int64(1)))


def _word(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    data = context.make_array(signature.args[0])(context, builder, values[0]).data
    return builder.gep(data, [values[1]])


def _loading(typing_context: Any, words: Any, at: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.load_atomic(_word(context, builder, signature, values), "acquire", 8)

    return types.int64(words, types.intp), generate


def _storing(typing_context: Any, words: Any, at: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.store_atomic(values[2], _word(context, builder, signature, values), "release", 8)
        return context.get_dummy_value()

    return types.void(words, types.intp, types.int64), generate


def _adding(typing_context: Any, words: Any, at: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.atomic_rmw("add", _word(context, builder, signature, values), values[2], "acq_rel")

    return types.int64(words, types.intp, types.int64), generate


def _pausing(typing_context: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        # Tells the processor that nothing is to be done here; others are left as they are, and give up sooner.
        if platform.machine() in ("x86_64", "AMD64"):
            kind = ir.FunctionType(ir.VoidType(), [])
            builder.call(_compiler.get_or_insert_function(builder.module, kind, "llvm.x86.sse2.pause"), [])
        return context.get_dummy_value()

    return types.void(), generate


def _giving_way(typing_context: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kind = ir.FunctionType(ir.IntType(32), [])
        builder.call(_compiler.get_or_insert_function(builder.module, kind, "sched_yield"), [])
        return context.get_dummy_value()

    return types.void(), generate


_give_way: Any = cast(Any, intrinsic)(_giving_way)
_pause: Any = cast(Any, intrinsic)(_pausing)
_load_acquire: Any = cast(Any, intrinsic)(_loading)
_store_release: Any = cast(Any, intrinsic)(_storing)
_add: Any = cast(Any, intrinsic)(_adding)
