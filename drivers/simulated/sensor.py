"""The camera's sensor: lens blur, electrons, noise, grey levels.

Noise is a table of normal deviates read from a place that depends on seed, frame and row: the same run gives the
same frames, and no frame waits for a random generator. Shot noise is taken as normal (at 15,000 electrons full well
its skewness is below 0.05 down to 3 % of the range).
"""

# Kernels: numba types their arguments.
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from scanner.kernel import kernel

Plane = NDArray[np.float32]

DEVIATES = 1 << 20
ROW_LIMIT = 1 << 14
"""Longest row of a frame, px: what the table carries beyond its places to begin at"""


@cache
def deviates() -> Plane:
    """The table: DEVIATES + ROW_LIMIT normal deviates, the last ROW_LIMIT repeating the first; mean 0, variance 1."""
    table = np.random.default_rng(20111).standard_normal(DEVIATES, dtype=np.float32)
    table = (table - table.mean()) / table.std()
    return np.concatenate((table, table[:ROW_LIMIT]))


def blur_taps(sigma_px: float) -> Plane:
    """Half of a Gaussian kernel from its middle outwards, float32, the whole summing to 1; one tap for no blur."""
    if sigma_px <= 0:
        return np.ones(1, dtype=np.float32)
    reach = max(1, int(np.ceil(4 * sigma_px)))
    taps = np.exp(-0.5 * (np.arange(reach + 1) / sigma_px) ** 2)
    return np.asarray(taps / (taps[0] + 2 * taps[1:].sum()), dtype=np.float32)


def sense(
    light: Plane,
    taps: Plane,
    electrons: float,
    dn_per_electron: float,
    read_noise_e: float | None,
    key: tuple[int, ...],
    out: NDArray[np.uint8] | NDArray[np.uint16],
    max_value: int,
    gain: Plane | None = None,
) -> None:
    """Turn light on the sensor into grey levels.

    Args:
        light: (H + 2 m, W + 2 m) float32: what falls beside the sensor, too, as far as the lens blurs it onto it.
        taps: see `blur_taps`; `len(taps) - 1` is m or less.
        electrons: that light 1 frees in this exposure.
        dn_per_electron: grey levels per electron.
        read_noise_e: rms, electrons; None: no noise at all.
        key: of the frame's noise: seed, number, whatever else tells it from others.
        out: (H, W), filled; saturates at `max_value`.
        max_value: largest grey level.
        gain: (H, W) float32, multiplies the blurred light (`print_blur`).
    """
    if min(light.shape[0] - out.shape[0], light.shape[1] - out.shape[1]) < 2 * (len(taps) - 1):
        raise ValueError(f"light of {light.shape} px does not reach as far around {out.shape} px as the lens blurs")
    rows, signs = _places(key, out.shape[0])
    rolling = np.empty((2 * len(taps) - 1, out.shape[1]), dtype=np.float32)
    line = np.empty(out.shape[1], dtype=np.float32)
    variance = 0.0 if read_noise_e is None else read_noise_e**2
    noisy = np.float32(0.0 if read_noise_e is None else 1.0)
    _sense(
        light,
        taps,
        np.empty((0, 0), dtype=np.float32) if gain is None else gain,
        np.float32(electrons),
        np.float32(dn_per_electron),
        np.float32(variance),
        noisy,
        deviates(),
        rows,
        signs,
        np.float32(max_value),
        rolling,
        line,
        out,
    )


def _places(key: tuple[int, ...], height: int) -> tuple[NDArray[np.int64], Plane]:
    """Where in the table each row begins, and its sign: a counter-based generator (splitmix64, Steele et al. 2014)."""
    with np.errstate(over="ignore"):
        z = np.arange(height, dtype=np.uint64) + np.uint64(1)
        for part in key:
            z = _mix(z * np.uint64(0x9E3779B97F4A7C15) + np.uint64(part & 0xFFFFFFFFFFFFFFFF))
    start = (z % np.uint64(DEVIATES)).astype(np.int64)
    sign = np.where(z >> np.uint64(63), np.float32(1), np.float32(-1))
    return start, sign


def _mix(z: NDArray[np.uint64]) -> NDArray[np.uint64]:
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@kernel
def _sense(light, taps, gain, electrons, dn, variance, noisy, table, starts, signs, top, rolling, line, out):
    height, width = out.shape
    reach = taps.shape[0] - 1
    margin = (light.shape[0] - height) // 2
    span = 2 * reach + 1
    half, zero = np.float32(0.5), np.float32(0.0)
    for r in range(-2 * reach, height):
        fresh = r + reach
        _blur_row(light[fresh + margin], taps, rolling[fresh % span])
        if r < 0:
            continue
        middle = rolling[r % span]
        for c in range(width):
            line[c] = taps[0] * middle[c]
        for k in range(1, reach + 1):
            above, below = rolling[(r - k) % span], rolling[(r + k) % span]
            tap = taps[k]
            for c in range(width):
                line[c] += tap * (above[c] + below[c])
        if gain.shape[0]:
            sharper = gain[r]
            for c in range(width):
                line[c] *= sharper[c]
        normal = table[starts[r] : starts[r] + width]
        sign = signs[r] * noisy
        target = out[r]
        for c in range(width):
            e = line[c] * electrons
            grey = (e + sign * np.sqrt(e + variance) * normal[c]) * dn + half
            target[c] = np.uint16(min(max(grey, zero), top))


@kernel
def _blur_row(source, taps, result):
    width = result.shape[0]
    margin = (source.shape[0] - width) // 2
    for c in range(width):
        result[c] = taps[0] * source[c + margin]
    for k in range(1, taps.shape[0]):
        tap = taps[k]
        left, right = source[margin - k : margin - k + width], source[margin + k : margin + k + width]
        for c in range(width):
            result[c] += tap * (left[c] + right[c])


def warm_up() -> None:
    """Compile the kernel for both pixel formats (or load it from its cache)."""
    light = np.zeros((14, 22), dtype=np.float32)
    for out in (np.empty((8, 16), dtype=np.uint8), np.empty((8, 16), dtype=np.uint16)):
        sense(light, blur_taps(0.7), 1000.0, 0.01, 1.0, (0, 0), out, 255)
