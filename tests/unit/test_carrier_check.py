"""Wrong descriptions of an MCP image that decode without a residual are found out by the calibration."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from drivers.simulated.rigs import rig
from scanner import carrier_check
from scanner.carrier_check import CarrierFit, fit_carriers, in_order_of, require_carriers
from scanner.decode import decoder_for
from scanner.errors import DecodeError
from scanner.patterns import McpPattern, PatternSequence
from service.scan_patterns import pattern_for
from tests.unit.sequencer_bench import QUICK, take

CALIBRATION = rig("quick").calibration
PATTERN = pattern_for("mcp", {}, "y", QUICK)
assert isinstance(PATTERN, McpPattern)


@cache
def seen(scene: str, seed: int = 1):
    taken = take(PatternSequence(QUICK, PATTERN), scene=scene, seed=seed, mode=None, exposure_ns=None)
    return taken.frames[0], taken.format


def decoded(scene: str, described: McpPattern, seed: int = 1):
    frame, camera = seen(scene, seed)
    decoder = decoder_for(PatternSequence(QUICK, described), camera)
    decoder.add(0, frame)
    return frame, decoder.finish().rows


def checked(scene: str, described: McpPattern):
    return require_carriers(CALIBRATION, described, QUICK, *decoded(scene, described))


@pytest.mark.parametrize("scene", ["board", "bust", "sphere_board", "blocks"])
@pytest.mark.parametrize("seed", [1, 2])
def test_right_descriptions_pass_in_silence(scene, seed):
    frame, rows = decoded(scene, PATTERN, seed)
    fit, warning = require_carriers(CALIBRATION, PATTERN, QUICK, frame, rows)
    assert warning is None
    if fit is not None:
        assert abs(fit.stripes) < 0.3
        assert fit.contradicting < 0.1


@pytest.mark.parametrize(("in_order", "shown", "warned"), [(0.5, 8, True), (0.5, 0, False), (0.95, 8, False)])
def test_what_cannot_be_checked_is_said_where_few_stripes_are_in_order(in_order, shown, warned):
    values = np.full((240, 320), np.nan, np.float32)
    values[:, :shown] = np.arange(240, dtype=np.float32)[:, None]
    fit, warning = require_carriers(CALIBRATION, PATTERN, QUICK, np.zeros((240, 320), np.uint8), values, in_order)
    assert fit is None
    assert (warning is not None) == warned
    assert not warned or "only 50% are in order" in warning
    assert in_order_of({"agreement": {"order": in_order}}) == in_order
    assert in_order_of({"agreement": 0.9}) == 1.0


def test_the_first_stripe_taken_for_the_other_kind_is_refused():
    with pytest.raises(DecodeError, match="every stripe is 1 further on") as caught:
        checked("board", replace(PATTERN, first="unmodulated"))
    assert '"first"' in caught.value.hint


@pytest.mark.parametrize(("by", "says"), [(1, "2 back"), (-1, "2 further on")])
def test_codes_that_begin_elsewhere_are_refused(by, says):
    codes = PATTERN.codes[by:] + PATTERN.codes[:by]
    with pytest.raises(DecodeError, match=says):
        checked("board", replace(PATTERN, codes=codes))


def test_a_calibration_that_is_a_little_off_is_a_warning_and_no_error():
    frame, rows = decoded("board", PATTERN)
    lens = CALIBRATION.camera
    longer = replace(lens, matrix=lens.matrix * np.array([[1.001, 1, 1], [1, 1.001, 1], [1, 1, 1]]))
    fit, warning = require_carriers(replace(CALIBRATION, camera=longer), PATTERN, QUICK, frame, rows)
    assert fit is not None
    assert 0.2 < abs(fit.stripes) < 0.8
    assert (warning is not None) == (abs(fit.stripes) > 0.3 + 3 * fit.sigma_stripes)


def test_names_that_are_mixed_up_are_refused():
    """As after carriers that changed places: each stripe is where another one is."""
    frame, rows = decoded("board", PATTERN)
    pitch = PATTERN.pitch_px(QUICK)
    stripe = np.floor((rows + 0.5) / pitch)
    mixed = rows + pitch * 2 * np.where(stripe // 2 % 2 == 0, 5, -5).astype(np.float32)
    with pytest.raises(DecodeError, match="contradicts the frame"):
        require_carriers(CALIBRATION, PATTERN, QUICK, frame, np.where(np.isfinite(rows), mixed, np.nan))


def test_too_little_says_nothing():
    frame, rows = decoded("board", PATTERN)
    few = np.full_like(rows, np.nan)
    few[100:140, 100:140] = rows[100:140, 100:140]
    assert fit_carriers(CALIBRATION, PATTERN, QUICK, frame, few) is None


def test_of_two_carriers_a_tenth_apart_each_is_found_where_it_is():
    """As in the published pattern, over a stretch in which they are two cycles apart; the lower one is stronger."""
    n = 256
    cycles = [f * np.arange(n) / 1392 for f in (120.0, 132.0)]
    light = 1.0 * np.cos(2 * np.pi * cycles[0] + 0.3) + 0.6 * np.cos(2 * np.pi * cycles[1] + 1.9)
    stretch, length, has = np.zeros(n, np.intp), np.array([n]), np.ones(n, bool)
    alone = carrier_check._one_by_one(light, cycles, [has, has], stretch, length)
    for part, phase in zip(alone, cycles, strict=True):
        offsets, _ = carrier_check._best_offsets(part, phase, stretch, length, has)
        assert abs(offsets[0]) < 0.005


def test_shading_along_stripes_hides_no_carrier():
    frame, rows = decoded("board", PATTERN)
    steep = (frame * np.linspace(0.15, 1, frame.shape[1])).astype(np.uint8)
    fit = fit_carriers(CALIBRATION, PATTERN, QUICK, steep, rows)
    assert fit is not None
    assert fit.stretches >= 0.9 * fit.expected
    assert fit.contradicting < 0.1


@pytest.mark.parametrize(("sigma", "refused"), [(0.0016, True), (0.00017, False)])
def test_names_that_scatter_by_stripes_are_refused(sigma, refused, monkeypatch):
    """As measured with the published pattern: two carriers exchanged in the description, and the right one."""
    monkeypatch.setattr(carrier_check, "fit_carriers", lambda *_: CarrierFit(168, 168, 0.065, 0.0, 0.00195, sigma))
    if not refused:
        assert require_carriers(CALIBRATION, PATTERN, QUICK, np.empty(0), np.empty(0))[1] is None
        return
    with pytest.raises(DecodeError, match="scatter"):
        require_carriers(CALIBRATION, PATTERN, QUICK, np.empty(0), np.empty(0))
