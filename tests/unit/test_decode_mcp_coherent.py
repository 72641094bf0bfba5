"""MCP on a calibrated rig: carriers held against the phases that each stripe's depth gives them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from drivers.simulated.rigs import rig
from scanner.crossings import GRID_PX, Crossings, crossings_of, turned_over
from scanner.decode.mcp import McpDecoder, coherent, emissions
from scanner.decode.mcp.emissions import OUTLIER, SPREAD, Amplitudes, Waves
from scanner.decode.mcp.model import PatternModel
from scanner.patterns import McpPattern, PatternSequence
from service.scan_patterns import pattern_for
from tests.unit.sequencer_bench import QUICK, take

CALIBRATION = rig("quick").calibration
PATTERN = pattern_for("mcp", {}, "y", QUICK)
assert isinstance(PATTERN, McpPattern)
MODEL = PatternModel.of(PATTERN, QUICK)
MODULATION = np.linspace(1, 0.6, MODEL.channels).astype(np.float32)
FLOOR = np.full(MODEL.channels, 0.01, np.float32)


def crossings() -> Crossings:
    found = crossings_of(CALIBRATION, PATTERN, QUICK)
    assert found is not None
    return found


def peaks(count, offset=lambda x, y: 0.0 * x, noise=0.01, seed=0):
    """Amplitudes as peaks of random stripes would show them, and the stripes."""
    random = np.random.default_rng(seed)
    table = crossings()
    height, width = ((n - 1) * GRID_PX for n in table.along.shape[:2])
    x, y = (random.uniform(0.25 * side, 0.75 * side, count).astype(np.float32) for side in (width, height))
    stripe = random.integers(0, MODEL.stripes, count)
    u = np.nan_to_num(coherent._along(table.along, x, y, stripe)) + 0.5 + offset(x, y)
    turns = 2 * np.pi * MODEL.carriers * u[:, None]
    mean = MODEL.ratio[stripe] * MODULATION
    wave = np.stack([mean * np.cos(turns), -table.sense * mean * np.sin(turns)], axis=2).reshape(count, -1)
    wave = (wave + random.normal(0, noise, wave.shape)).astype(np.float32)
    ratio = np.hypot(wave[:, ::2], wave[:, 1::2])
    sigma = np.full(ratio.shape, noise, np.float32)
    waves = Waves(wave, x, y, np.full(count, 64, np.float32))
    return Amplitudes(ratio, sigma, np.ones(count, np.float32), waves), stripe


def test_a_stripe_is_crossed_where_the_projector_sees_its_point():
    table = crossings()
    pixel = np.array([2 * GRID_PX, 3 * GRID_PX])
    ray = np.append(CALIBRATION.camera.normalised(pixel.astype(float)), 1.0)
    depths = np.linspace(300, 3000, 200_001)
    seen = CALIBRATION.projector.project(CALIBRATION.to_projector(ray * depths[:, None]))
    middles = (np.arange(MODEL.stripes) + 0.5) * MODEL.pitch - 0.5
    inside = (middles > seen[:, 1].min()) & (middles < seen[:, 1].max())
    assert inside.sum() > 3
    order = np.argsort(seen[:, 1])
    expected = np.interp(middles[inside], seen[order, 1], seen[order, 0])
    np.testing.assert_allclose(table.along[3, 2, inside], expected, atol=2e-3)


def test_an_image_upside_down_has_its_table_turned():
    table, height = crossings(), CALIBRATION.camera.size[1]
    x, y = np.array([100.0, 200.0], np.float32), np.array([90.0, 130.0], np.float32)
    stripe = np.array([8, 20])
    there = coherent._along(turned_over(table, height).along, x, height - 1 - y, stripe)
    np.testing.assert_allclose(there, coherent._along(table.along, x, y, stripe), atol=2e-3)


def test_a_common_offset_that_changes_over_the_image_is_found():
    seen, stripe = peaks(600, lambda x, y: 1.5 + 1e-3 * x - 2e-3 * y)
    found = coherent.align(seen, np.eye(MODEL.stripes, dtype=np.float32)[stripe], crossings(), MODEL)
    assert found.holds
    assert found.spread < 0.15
    np.testing.assert_allclose((found.offset, found.by_x, found.by_y), (1.5, 1e-3, -2e-3), atol=0.05)


@pytest.mark.parametrize("offset", [lambda x, _: 40 * np.sin(x), lambda x, _: x * 0.3])
def test_phases_that_are_not_the_calibrations_are_not_believed(offset):
    seen, stripe = peaks(600, offset)
    assert not coherent.align(seen, np.eye(MODEL.stripes, dtype=np.float32)[stripe], crossings(), MODEL).holds


def test_few_witnesses_say_nothing():
    seen, stripe = peaks(8)
    assert coherent.align(seen, np.eye(MODEL.stripes, dtype=np.float32)[stripe], crossings(), MODEL) == coherent.NONE


def test_likelihoods_are_those_of_the_plain_form():
    seen, stripe = peaks(200, noise=0.03)
    shift = coherent.Alignment(0.1, 1e-4, 0.0, 0.2, 100, True)
    table = replace(crossings(), along=crossings().along.copy())
    lost = int(np.flatnonzero((MODEL.ratio > 0).any(axis=1))[3])
    table.along[:, :, lost] = np.nan
    got, stray = coherent.log_likelihood(seen, table, shift, MODEL, MODULATION, FLOOR)
    expected, nothing = plain(seen, table, shift)
    np.testing.assert_allclose(stray, nothing, atol=1e-4)
    np.testing.assert_allclose(got, expected, atol=0.05)
    there = np.isfinite(coherent._along(table.along, seen.waves.x, seen.waves.y, stripe))
    coded = (MODEL.ratio[stripe] > 0).any(axis=1) & there
    own = got[np.arange(len(stripe)), stripe]
    blank = got[:, ~(MODEL.ratio > 0).any(axis=1)].max(axis=1)
    assert (own[coded] > blank[coded] + 3).mean() > 0.95


def test_clear_peaks_and_short_windows_count_by_their_amplitudes_alone():
    seen, stripe = peaks(60)
    seen.waves.length[::3] = 20
    posterior = np.full((60, MODEL.stripes), 1 / MODEL.stripes, np.float32)
    posterior[1::3] = np.eye(MODEL.stripes)[stripe[1::3]]
    by_amplitude = emissions.log_likelihood(seen, MODEL, MODULATION, FLOOR)
    phases, channels = (crossings(), coherent.Alignment(0.0, 0.0, 0.0, 0.1, 100, True)), (MODEL, MODULATION, FLOOR)
    by_phase = coherent.log_likelihood(seen, *phases, *channels)
    settled = coherent.settle(by_amplitude, seen, 64, posterior, phases, channels)
    for got, amplitude, phase in zip(settled, by_amplitude, by_phase, strict=True):
        np.testing.assert_array_equal(got[::3], amplitude[::3])
        np.testing.assert_array_equal(got[1::3], amplitude[1::3])
        np.testing.assert_array_equal(got[2::3], phase[2::3])
        assert (amplitude != phase).any()


def plain(seen, table, shift):
    """`coherent.log_likelihood` written out."""
    count, channels = seen.sigma.shape
    result = np.zeros((count, MODEL.stripes))
    square = seen.sigma.astype(np.float64) ** 2 + FLOOR**2
    flat = 1 / (np.pi * (np.maximum(1.5 * MODEL.ratio.max(axis=0), 1e-3) + 2.5 * np.sqrt(square)) ** 2)
    pair = seen.waves.parts.reshape(count, channels, 2).astype(np.float64)
    for s in range(MODEL.stripes):
        bare = coherent._along(table.along, seen.waves.x, seen.waves.y, np.full(count, s))
        u = bare + 0.5 + shift.offset + shift.by_x * seen.waves.x + shift.by_y * seen.waves.y
        turning = np.exp(-2j * np.pi * MODEL.carriers * np.nan_to_num(u[:, None]))
        mean = MODEL.ratio[s] * MODULATION
        wave = (pair[..., 0] - 1j * table.sense * pair[..., 1]) * turning - mean
        along, beside = square + (SPREAD * mean) ** 2, square + (max(shift.spread, coherent.LEAST_SPREAD) * mean) ** 2
        distance = wave.real**2 / along + wave.imag**2 / beside
        density = (1 + distance / 6) ** -4 / (2 * np.pi * np.sqrt(along * beside))
        logs = np.log((1 - OUTLIER) * density + OUTLIER * flat).sum(axis=1)
        lowest = np.log(OUTLIER * flat).sum(axis=1)
        there = (bare > -1) & (bare < table.across)
        result[:, s] = np.where(there | ~(mean > 0).any(), logs, lowest)
    return result, np.log(flat).sum(axis=1)


@cache
def seen_by_camera(scene):
    taken = take(PatternSequence(QUICK, PATTERN), scene=scene, seed=1, mode=None, exposure_ns=None)
    return taken.frames[0], taken.format


def decoded(scene, calibration):
    frame, camera = seen_by_camera(scene)
    decoder = McpDecoder(PatternSequence(QUICK, PATTERN), camera, calibration)
    decoder.add(0, frame)
    return decoder.finish()


def test_a_calibrated_rig_decodes_by_phases_and_says_so():
    without, found = decoded("blocks", None), decoded("blocks", CALIBRATION)
    assert "coherent" not in without.details
    assert found.details["coherent"]["used"]
    assert abs(found.details["coherent"]["offset_px"]) < 0.1
    assert len(found.peaks) >= len(without.peaks)


def test_a_calibration_that_is_far_off_changes_nothing_and_that_is_said():
    lens = CALIBRATION.projector
    off = replace(lens, matrix=lens.matrix * np.array([[1.3, 1, 1], [1, 1, 1], [1, 1, 1]]))
    without, found = decoded("blocks", None), decoded("blocks", replace(CALIBRATION, projector=off))
    assert not found.details["coherent"]["used"]
    np.testing.assert_array_equal(found.rows, without.rows)
