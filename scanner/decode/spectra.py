"""A kernel: what the samples of a fringe set are made of, summed over a few pixels. What it means, `harmonics` tells.

At each pixel I = A + Re sum_m h_m e^(i m alpha), m up to N / 2. A response gives overtones
h_m = r_m e^(i (m - 1) theta) h_1 with one r_m for all pixels, where theta is the angle of h_1: sums of products tell
r_m, and what is not explained.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.addresses import pixels_at
from scanner.kernel import contracting_kernel

ORDERS = 4
"""The highest order that is looked at: gamma 2.2 gives the fifth overtone a hundredth of the second's height."""

POWER, REAL, IMAGINARY, AA, AB, BB, SEEN_REAL, SEEN_IMAGINARY, MEANT_REAL, MEANT_IMAGINARY = range(10)
SUMS = 10
"""Of an order, with b = e^(i (m - 1) theta) h_1: of |b|^2; of h times conj(b); where h is real (m = N / 2), of the
squares and products of the parts of conj(b); of h and of b over the pixel's level."""


@contracting_kernel
def sum_spectra(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    weights: NDArray[np.float32],
    folded: int,
    runs: NDArray[np.intp],
    length: int,
    every: int,
    good: NDArray[np.bool_],
    level: NDArray[np.float32],
    sums: NDArray[np.float64],
) -> float:
    """Add up the spectra of one set at the good pixels of one run in `every`.

    Args:
        addresses: (N,) of the set's frames. like: (0,) array of their dtype. weights: (M, 2, N) of the samples, to the
            real and imaginary part of each order's height. folded: the order N / 2, whose height is real; or 0.
        runs: (R,) first pixels; length: of each. good: (R, length). level: (R, length) mean grey level.
        sums: (ORDERS + 1, SUMS), by order, is added to.

    Returns:
        The sum of A over level.
    """
    orders, shifts = weights.shape[0], addresses.size
    total = 0.0
    for r in range(0, runs.size, every):
        for i in range(length):
            if not good[r, i]:
                continue
            share = 1.0 / max(np.float64(level[r, i]), 1e-3)
            mean = 0.0
            for n in range(shifts):
                mean += np.float64(pixels_at(addresses[n], runs[r] + i, 1, like)[0])
            total += mean / shifts * share
            unit_real, unit_imaginary = 1.0, 0.0
            meant_real, meant_imaginary = 0.0, 0.0
            for m in range(orders):
                real, imaginary = 0.0, 0.0
                for n in range(shifts):
                    sample = np.float64(pixels_at(addresses[n], runs[r] + i, 1, like)[0])
                    real += weights[m, 0, n] * sample
                    imaginary += weights[m, 1, n] * sample
                if m == 0:
                    height = np.sqrt(real * real + imaginary * imaginary) + 1e-12
                    unit_real, unit_imaginary = real / height, imaginary / height
                    meant_real, meant_imaginary = real, imaginary
                else:
                    meant_real, meant_imaginary = (
                        meant_real * unit_real - meant_imaginary * unit_imaginary,
                        meant_real * unit_imaginary + meant_imaginary * unit_real,
                    )
                row = sums[m + 1]
                row[POWER] += meant_real * meant_real + meant_imaginary * meant_imaginary
                if m + 1 == folded:
                    row[REAL] += meant_real * real
                    row[IMAGINARY] -= meant_imaginary * real
                    row[AA] += meant_real * meant_real
                    row[AB] -= meant_real * meant_imaginary
                    row[BB] += meant_imaginary * meant_imaginary
                else:
                    row[REAL] += meant_real * real + meant_imaginary * imaginary
                    row[IMAGINARY] += meant_real * imaginary - meant_imaginary * real
                row[SEEN_REAL] += real * share
                row[SEEN_IMAGINARY] += imaginary * share
                row[MEANT_REAL] += meant_real * share
                row[MEANT_IMAGINARY] += meant_imaginary * share
    return total
