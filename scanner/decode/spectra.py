"""Kernels: what the samples of fringe sets are made of, summed over a few pixels. What it means, `harmonics` tells.

At each pixel I = A + Re sum_m h_m e^(i m alpha), m up to N / 2. A response gives overtones
h_m = r_m e^(i (m - 1) theta) h_1 with one r_m for all pixels, where theta is the angle of h_1: sums of products tell
r_m, and what is not explained.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.addresses import addresses_of, pixels_at
from scanner.kernel import kernel, summing_kernel

ORDERS = 4
"""The highest order that is looked at: gamma 2.2 gives the fifth overtone a hundredth of the second's height."""

POWER, REAL, IMAGINARY, AA, AB, BB, SEEN_REAL, SEEN_IMAGINARY, MEANT_REAL, MEANT_IMAGINARY = range(10)
SUMS = 10
"""Of an order, with b = e^(i (m - 1) theta) h_1: of |b|^2; of h times conj(b); where h is real (m = N / 2), of the
squares and products of the parts of conj(b); of h and of b over the pixel's level."""

MOST_SHARE = 0.45
"""Of an overtone in its fringe: gamma 3 gives .4. And each order is lower than the one before, from LEAST_SHARE on."""

LEAST_SHARE = 0.02

LEAST_PIXELS = 128
"""Fewer say nothing of a whole scan's overtones."""

_F0 = np.float32(0)


@kernel
def sum_sets(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    starts: NDArray[np.intp],
    weights: NDArray[np.float32],
    kinds: NDArray[np.intp],
    runs: NDArray[np.intp],
    every: int,
    good: NDArray[np.bool_],
    level: NDArray[np.float32],
    sums: NDArray[np.float64],
    levels: NDArray[np.float64],
    ratios: NDArray[np.complex128],
) -> float:
    """Add up the spectra of all sets that are whole, and tell what explains most of each order's height.

    Args:
        starts: (K + 1,) where sets begin in `addresses`. weights, kinds: of `harmonics.HeightWeights`.
        addresses, like, runs, every, good, level: see `sum_spectra`.
        sums: (K, ORDERS + 1, SUMS), zeros, written. levels: (K,), written: sums of A over level.
        ratios: (K, ORDERS), written: of each order over the fringe, as common to all pixels.

    Returns:
        The sum over these pixels of what a response's overtones add to the squared residual, grey levels squared.
    """
    energy = 0.0
    for k in range(kinds.shape[0]):
        shifts, orders, folded = kinds[k, 0], kinds[k, 1], kinds[k, 2]
        if orders > 0:
            levels[k] = sum_spectra(
                addresses[starts[k] : starts[k] + shifts], like, weights[k, :orders, :, :shifts], folded,
                runs, good.shape[1], every, good, level, sums[k],
            )  # fmt: skip
            for m in range(2, orders + 1):
                ratios[k, m - 1] = _ratio(sums[k, m], m == folded)
            if of_response(ratios[k, 1:orders]):
                # Of order N / 2 half is seen, and weighs twice.
                for m in range(2, orders + 1):
                    energy += sums[k, 1, POWER] * shifts / 2 * abs(ratios[k, m - 1]) ** 2
    return energy


@kernel
def of_response(ratios: NDArray[np.complex128]) -> bool:
    """Whether a response could have made these overtones; frames that changed places and scenes that move make others.

    Args:
        ratios: (M - 1,) of orders 2 .. M.
    """
    before = np.inf
    for m in range(ratios.size):
        share = abs(ratios[m])
        if share >= MOST_SHARE or share > max(before, LEAST_SHARE):
            return False
        before = share
    return ratios.size > 0


@kernel
def _ratio(sums: NDArray[np.float64], folded: bool) -> complex:
    """The ratio that explains most of an order's height."""
    if not folded:
        power = max(sums[POWER], 1e-12)
        return complex(sums[REAL] / power, sums[IMAGINARY] / power)
    aa, ab, bb = sums[AA], sums[AB], sums[BB]
    determinant = aa * bb - ab * ab
    if determinant <= 1e-9 * aa * bb:
        return complex(0.0, 0.0)
    real, imaginary = bb * sums[REAL] - ab * sums[IMAGINARY], aa * sums[IMAGINARY] - ab * sums[REAL]
    return complex(real / determinant, imaginary / determinant)


@summing_kernel
def take_explained_off(
    addresses: NDArray[np.intp],
    like: NDArray[Any],
    starts: NDArray[np.intp],
    weights: NDArray[np.float32],
    kinds: NDArray[np.intp],
    ratios: NDArray[np.complex128],
    runs: NDArray[np.intp],
    residual: NDArray[np.float32],
) -> None:
    """Take off squared residuals what overtones that a response made are of them, and leave 0 at least.

    Args:
        residual: (R, L) float32, changed: of L pixels from each of `runs` on. The others: see `sum_sets`.
    """
    length = residual.shape[1]
    grey, rows = np.empty((kinds[:, 0].max(), length), np.float32), np.empty((7, length), np.float32)
    unit_real, unit_imaginary, meant_real, meant_imaginary = rows[0], rows[1], rows[2], rows[3]
    real, imaginary, explained = rows[4], rows[5], rows[6]
    for r in range(runs.size):
        explained[:] = 0
        for k in range(kinds.shape[0]):
            shifts, orders, folded = kinds[k, 0], kinds[k, 1], kinds[k, 2]
            if orders < 2 or not of_response(ratios[k, 1:orders]):
                continue
            for n in range(shifts):
                samples = pixels_at(addresses[starts[k] + n], runs[r], length, like)
                for i in range(length):
                    grey[n, i] = samples[i]
            _height(grey[:shifts], weights[k, 0], length, meant_real, meant_imaginary)
            for i in range(length):
                x, y = meant_real[i], meant_imaginary[i]
                height = max(np.sqrt(x * x + y * y), np.float32(1e-12))
                unit_real[i], unit_imaginary[i] = x / height, y / height
            for m in range(2, orders + 1):
                _height(grey[:shifts], weights[k, m - 1], length, real, imaginary)
                c, s = np.float32(ratios[k, m - 1].real), np.float32(ratios[k, m - 1].imag)
                weight = np.float32(shifts if m == folded else shifts / 2)
                for i in range(length):
                    x = meant_real[i] * unit_real[i] - meant_imaginary[i] * unit_imaginary[i]
                    y = meant_real[i] * unit_imaginary[i] + meant_imaginary[i] * unit_real[i]
                    meant_real[i], meant_imaginary[i] = x, y
                    there_real, there_imaginary = x * c - y * s, x * s + y * c
                    if m == folded:
                        there_imaginary = np.float32(0)
                    explained[i] += weight * (
                        there_real * (real[i] + real[i] - there_real)
                        + there_imaginary * (imaginary[i] + imaginary[i] - there_imaginary)
                    )
        for i in range(length):
            residual[r, i] = max(residual[r, i] - explained[i], np.float32(0))


def warm_up() -> None:
    """Compile what only scans with overtones come to."""
    for dtype in (np.uint8, np.uint16):
        frame = np.zeros(4, dtype)
        take_explained_off(
            addresses_of([frame] * 4), frame[:0], np.array([0, 4], np.intp), np.zeros((1, ORDERS, 2, 4), np.float32),
            np.array([[4, 2, 2]], np.intp), np.zeros((1, ORDERS), np.complex128), np.zeros(1, np.intp),
            np.zeros((1, 4), np.float32),
        )  # fmt: skip


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
    grey, rows = np.empty((shifts, length), np.float32), np.empty((9, length), np.float32)
    count, share, real, imaginary = rows[0], rows[1], rows[2], rows[3]
    unit_real, unit_imaginary, meant_real, meant_imaginary, before = rows[4], rows[5], rows[6], rows[7], rows[8]
    for r in range(0, runs.size, every):
        for n in range(shifts):
            samples = pixels_at(addresses[n], runs[r], length, like)
            for i in range(length):
                grey[n, i] = samples[i]
        for i in range(length):
            # Others are counted as nothing: all pixels of a run go through the same vectors.
            count[i] = good[r, i]
            share[i] = count[i] / max(level[r, i], np.float32(1e-3))
        of_run = _F0
        for n in range(shifts):
            for i in range(length):
                of_run += grey[n, i] * share[i]
        total += float(of_run) / shifts
        for m in range(orders):
            _height(grey, weights[m], length, real, imaginary)
            for i in range(length):
                if m == 0:
                    height = np.sqrt(real[i] * real[i] + imaginary[i] * imaginary[i]) + np.float32(1e-12)
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
    grey: NDArray[np.float32],
    weights: NDArray[np.float32],
    length: int,
    real: NDArray[np.float32],
    imaginary: NDArray[np.float32],
) -> None:
    """One order's, of each pixel of a run."""
    for i in range(length):
        real[i], imaginary[i] = _F0, _F0
    for n in range(grey.shape[0]):
        to_real, to_imaginary = weights[0, n], weights[1, n]
        for i in range(length):
            real[i] += to_real * grey[n, i]
            imaginary[i] += to_imaginary * grey[n, i]


@summing_kernel
def _add(
    row: NDArray[np.float64],
    folded: bool,
    length: int,
    count: NDArray[np.float32],
    share: NDArray[np.float32],
    real: NDArray[np.float32],
    imaginary: NDArray[np.float32],
    meant_real: NDArray[np.float32],
    meant_imaginary: NDArray[np.float32],
) -> None:
    """One order of one run: of so few pixels a sum in float32 is good to a millionth."""
    rr, ri, ir, ii = _F0, _F0, _F0, _F0
    aa, ab, bb = _F0, _F0, _F0
    seen_real, seen_imaginary, there_real, there_imaginary = _F0, _F0, _F0, _F0
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
