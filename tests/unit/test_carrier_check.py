"""Wrong descriptions of an MCP image that decode without a residual are found out by the calibration."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from drivers.simulated.rigs import rig
from scanner.carrier_check import fit_carriers, require_carriers
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
