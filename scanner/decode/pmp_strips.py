"""The pass over all pixels in strips that threads share, without the interpreter between two of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.gate import OPEN, SHUT, come_and_go, next_turn, wait_for
from scanner.decode.pmp_kernels import decode_pixels
from scanner.kernel import kernel


@kernel
def decode_strips(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    starts: NDArray[np.intp],
    weights: NDArray[np.float32],
    grams: NDArray[np.float32],
    shifts: NDArray[np.intp],
    clip: int,
    gains: NDArray[np.float32],
    rungs: NDArray[np.float32],
    ratios: NDArray[np.float32],
    errors: NDArray[np.float32],
    floors: NDArray[np.float32],
    noise: NDArray[np.float32],
    scale: NDArray[np.float32],
    limits: NDArray[np.float32],
    periodic: bool,
    finest: int,
    position: NDArray[np.float32],
    sigma: NDArray[np.float32],
    confidence: NDArray[np.float32],
    albedo: NDArray[np.float32],
    modulation: NDArray[np.float32],
    reason: NDArray[np.uint8],
    rooms: NDArray[np.float32],
    begins: NDArray[np.intp],
    gate: NDArray[np.int64],
    counts: NDArray[np.int64],
) -> bool:
    """Decode strips until there is none left; False, and nothing is done, if the gate stays shut too long.

    Args:
        addresses ... rooms, counts: see `decode_pixels`; floors, noise and limits may be written until the gate opens.
        begins: (S + 1,) first pixels of strips, and their end. gate: of `new_gate`.
    """
    state = wait_for(gate)
    if state != OPEN:
        return state != SHUT
    come_and_go(gate, 1)
    strip = next_turn(gate)
    while strip < begins.size - 1:
        decode_pixels(
            addresses, like, starts, weights, grams, shifts, clip, gains, rungs, ratios, errors, floors, noise, scale,
            limits, periodic, finest, begins[strip], begins[strip + 1],
            position, sigma, confidence, albedo, modulation, reason, rooms, counts,
        )  # fmt: skip
        strip = next_turn(gate)
    come_and_go(gate, -1)
    return True
