"""Four samples a pixel by one instruction, against NumPy; and sets fitted by it against the fit without it."""

from __future__ import annotations

import numpy as np
import pytest

from scanner.decode import pmp_sums
from scanner.decode.addresses import addresses_of
from scanner.kernel import contracting_kernel, kernel
from scanner.lane_quads import any_reaches, brighter, brightest, dot, energy, has_quads, quads, weights_of
from scanner.lanes import LANES, store, whole

WEIGHTS = (99, -70, 0, -128)
PACKED = weights_of(*WEIGHTS)


@kernel
def there(like):
    return has_quads(like)


@kernel
def taken(addresses, like, level, found):
    for v in range(0, found.shape[1], LANES):
        x = quads(addresses, 0, v, like)
        store(found[0], v, dot(x, PACKED, -5))
        store(found[1], v, energy(x, 7))
        store(found[2], v, brightest(brighter(x, quads(addresses, 4, v, like))))
        store(found[3], v, whole(any_reaches(x, level)))


@contracting_kernel
def fitted(addresses, like, shifts, by_quads, phases, squares):
    bright = pmp_sums.no_quads()
    for v in range(0, phases.size, LANES):
        energies = whole(0)
        if by_quads and shifts == 8:
            p, q, _, energies, bright = pmp_sums._sum_eight(addresses, like, 0, v, energies, bright)
            scale = pmp_sums._LONG_EIGHT
        elif by_quads:
            p, q, _, energies, bright = pmp_sums._sum_four(addresses, like, 0, v, energies, bright)
            scale = pmp_sums._QUARTER
        elif shifts == 8:
            p, q, scale, _, _, _ = pmp_sums._fit_eight(addresses, like, 0, np.float32(1), v)
        else:
            p, q, scale, _, _, _ = pmp_sums._fit_four(addresses, like, 0, np.float32(1), v)
        store(phases, v, pmp_sums._phase(p, q))
        store(squares, v, scale * (p * p + q * q))


needs_quads = pytest.mark.skipif(
    not there(np.empty(0, np.uint8)), reason="this processor has no dot products of bytes: nothing is done in quads"
)


def frames_of(count, pixels=4 * LANES, seed=3):
    frames = np.random.default_rng(seed).integers(0, 256, (count, pixels), dtype=np.uint8)
    frames[:, :4] = [0, 255, 128, 127]
    return frames


def test_frames_of_more_than_eight_bits_are_not_for_quads():
    assert not there(np.empty(0, np.uint16))


@needs_quads
@pytest.mark.parametrize("level", [0, 130, 255, 4095])
def test_sums_energy_and_extremes_are_exact(level):
    frames = frames_of(8)
    frames[:, LANES : 2 * LANES] //= 2
    found = np.empty((4, frames.shape[1]), np.int32)
    taken(addresses_of(list(frames)), frames[0, :0], level, found)
    x = frames[:4].astype(np.int64)
    assert np.array_equal(found[0], np.tensordot(WEIGHTS, x, 1) - 5)
    assert np.array_equal(found[1], (x * (x - 128)).sum(axis=0) + 7)
    assert np.array_equal(found[2], frames.max(axis=0))
    any_in_vector = (frames[:4] >= min(level, 255)).reshape(4, -1, LANES).any(axis=(0, 2))
    assert np.array_equal(found[3], np.repeat(any_in_vector, LANES))


@needs_quads
@pytest.mark.parametrize("shifts", [4, 8])
def test_fringes_have_the_same_phase_and_height_with_quads_and_without(shifts):
    rng = np.random.default_rng(5)
    pixels = 8 * LANES
    angle = 2 * np.pi * (rng.random(pixels) - np.arange(shifts)[:, None] / shifts)
    frames = np.rint(rng.uniform(90, 120, pixels) + rng.uniform(5, 80, pixels) * np.cos(angle)).astype(np.uint8)
    phases, squares = np.empty((2, pixels), np.float32), np.empty((2, pixels), np.float32)
    for by_quads in (0, 1):
        fitted(addresses_of(list(frames)), frames[0, :0], shifts, bool(by_quads), phases[by_quads], squares[by_quads])
    apart = phases[1] - phases[0]
    # Weights of 99 and 70 in place of cosines: 2e-5 of what rounding left, 1 / B grey levels.
    assert np.abs(apart - np.rint(apart)).max() < 1e-6
    assert np.abs(squares[1] / squares[0] - 1).max() < 1e-5
