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
from scanner.kernel import summing_kernel

ORDERS = 4
"""The highest order that is looked at: gamma 2.2 gives the fifth overtone a hundredth of the second's height."""

POWER, REAL, IMAGINARY, AA, AB, BB, SEEN_REAL, SEEN_IMAGINARY, MEANT_REAL, MEANT_IMAGINARY = range(10)
SUMS = 10
"""Of an order, with b = e^(i (m - 1) theta) h_1: of |b|^2; of h times conj(b); where h is real (m = N / 2), of the
squares and products of the parts of conj(b); of h and of b over the pixel's level."""


@summing_kernel
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
    grey, rows = np.empty((shifts, length)), np.empty((9, length))
    count, share, real, imaginary = rows[0], rows[1], rows[2], rows[3]
    unit_real, unit_imaginary, meant_real, meant_imaginary, before = rows[4], rows[5], rows[6], rows[7], rows[8]
    for r in range(0, runs.size, every):
        for n in range(shifts):
            samples = pixels_at(addresses[n], runs[r], length, like)
            for i in range(length):
                grey[n, i] = samples[i]
        for i in range(length):
            # Others are counted as nothing: all pixels of a run go through the same vectors.
            count[i] = 1.0 if good[r, i] else 0.0
            share[i] = count[i] / max(np.float64(level[r, i]), 1e-3)
        for n in range(shifts):
            for i in range(length):
                total += grey[n, i] * share[i] / shifts
        for m in range(orders):
            _height(grey, weights[m], length, real, imaginary)
            for i in range(length):
                if m == 0:
                    height = np.sqrt(real[i] * real[i] + imaginary[i] * imaginary[i]) + 1e-12
                    unit_real[i], unit_imaginary[i] = real[i] / height, imaginary[i] / height
                    meant_real[i], meant_imaginary[i] = real[i], imaginary[i]
                else:
                    before[i] = meant_real[i]
                    meant_real[i] = meant_real[i] * unit_real[i] - meant_imaginary[i] * unit_imaginary[i]
                    meant_imaginary[i] = before[i] * unit_imaginary[i] + meant_imaginary[i] * unit_real[i]
            _add(sums[m + 1], m + 1 == folded, length, count, share, real, imaginary, meant_real, meant_imaginary)
    return total


@summing_kernel
def _height(
    grey: NDArray[np.float64],
    weights: NDArray[np.float32],
    length: int,
    real: NDArray[np.float64],
    imaginary: NDArray[np.float64],
) -> None:
    """One order's, of each pixel of a run."""
    for i in range(length):
        real[i], imaginary[i] = 0.0, 0.0
    for n in range(grey.shape[0]):
        to_real, to_imaginary = np.float64(weights[0, n]), np.float64(weights[1, n])
        for i in range(length):
            real[i] += to_real * grey[n, i]
            imaginary[i] += to_imaginary * grey[n, i]


@summing_kernel
def _add(
    row: NDArray[np.float64],
    folded: bool,
    length: int,
    count: NDArray[np.float64],
    share: NDArray[np.float64],
    real: NDArray[np.float64],
    imaginary: NDArray[np.float64],
    meant_real: NDArray[np.float64],
    meant_imaginary: NDArray[np.float64],
) -> None:
    """One order of one run."""
    rr, ri, ir, ii = 0.0, 0.0, 0.0, 0.0
    aa, ab, bb = 0.0, 0.0, 0.0
    seen_real, seen_imaginary, there_real, there_imaginary = 0.0, 0.0, 0.0, 0.0
    for i in range(length):
        a, b = meant_real[i] * count[i], meant_imaginary[i] * count[i]
        rr += a * real[i]
        ri += a * imaginary[i]
        ir += b * real[i]
        ii += b * imaginary[i]
        aa += a * meant_real[i]
        ab += a * meant_imaginary[i]
        bb += b * meant_imaginary[i]
        seen_real += real[i] * share[i]
        seen_imaginary += imaginary[i] * share[i]
        there_real += meant_real[i] * share[i]
        there_imaginary += meant_imaginary[i] * share[i]
    row[POWER] += aa + bb
    if folded:
        row[REAL] += rr
        row[IMAGINARY] -= ir
        row[AA] += aa
        row[AB] -= ab
        row[BB] += bb
    else:
        row[REAL] += rr + ii
        row[IMAGINARY] += ri - ir
    row[SEEN_REAL] += seen_real
    row[SEEN_IMAGINARY] += seen_imaginary
    row[MEANT_REAL] += there_real
    row[MEANT_IMAGINARY] += there_imaginary
