"""The pass of Gray and binary decoding in strips that threads share, without the interpreter between two of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.gate import OPEN, SHUT, come_and_go, next_turn, wait_for
from scanner.decode.graycode_kernels import decode_codes
from scanner.decode.reasons import REASONS
from scanner.kernel import kernel


@kernel
def decode_code_strips(
    addresses: NDArray[np.intp],
    kinds: NDArray[np.int64],
    levels: NDArray[np.intp],
    like: NDArray[Any],
    twice: NDArray[Any],
    coarse: int,
    clip: int,
    gray: bool,
    shift: int,
    sizes: NDArray[np.int64],
    noise: NDArray[np.float32],
    limits: NDArray[np.float32],
    ends: NDArray[np.float32],
    brief: bool,
    share: int,
    maps: NDArray[np.float32],
    reason: NDArray[np.uint8],
    marked: NDArray[np.uint8],
    begins: NDArray[np.intp],
    gate: NDArray[np.int64],
    counts: NDArray[np.int64],
) -> bool:
    """Decode strips until there is none left; False, and nothing is done, if the gate stays shut too long.

    Args:
        addresses ... marked: see `decode_codes`; noise may be written until the gate opens.
        begins: (S + 1,) first pixels of strips, and their end. gate: of `new_gate`.
        counts: (REASONS + A x bits + 1,) its counts, and behind these what it adds to `decided`.
    """
    state = wait_for(gate)
    if state != OPEN:
        return state != SHUT
    come_and_go(gate, 1)
    strip = next_turn(gate)
    while strip < begins.size - 1:
        decode_codes(
            addresses, kinds, levels, like, twice, coarse, clip, gray, shift, sizes, noise, limits, ends, brief, share,
            maps, reason, marked, begins[strip], begins[strip + 1], counts[:REASONS], counts[REASONS:],
        )  # fmt: skip
        strip = next_turn(gate)
    come_and_go(gate, -1)
    return True
