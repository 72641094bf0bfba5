"""Print that makes lines beside the carriers: the search must not take them for a projector of other pixels."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.registry import open_camera, open_projector
from scanner.clock import VirtualClock
from scanner.decode import decoder_for
from scanner.devices import CameraSettings, TriggerMode
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, ProjectorSize
from scanner.patterns.sequence import Precorrection

FOUND = (23.0, 32.0, 44.0, 53.0)
CHOSEN = (25.0, 34.0, 47.0, 57.0)
"""Those that `fringed scan --method mcp` chooses for this rig: print hides a part of each"""
WORDS = (0, 10, 13, 6, 1, 8, 15, 4, 3, 9, 14, 5, 2, 11, 12, 7)


def seen(pattern, seed):
    """The frame, the sequence, truth and calibration."""
    clock = VirtualClock()
    camera, projector = (
        open_("simulated", f"quick/two_albedo?seed={seed}", {}, clock) for open_ in (open_camera, open_projector)
    )
    size = ProjectorSize(projector.capabilities.width, projector.capabilities.height)
    sequence = PatternSequence(size, pattern, precorrection=Precorrection(gamma=2.3))
    camera.apply(CameraSettings(exposure_ns=33_333_333))
    projector.load([sequence.image(0)])
    camera.start(TriggerMode.SOFTWARE)
    projector.show(0)
    clock.sleep_until(clock.now_ns() + 100_000_000)
    camera.trigger()
    frame = camera.pop(1_000_000_000).pixels.copy()
    found = frame, sequence, camera.truth(), camera.true_calibration()
    camera.close()
    projector.close()
    return found


def decoded(frame, sequence, calibration):
    decoder = decoder_for(sequence, CameraFormat(*frame.shape[::-1]), calibration=calibration)
    decoder.add(0, frame)
    return decoder.finish()


@pytest.mark.parametrize(
    ("pattern", "seed"),
    [(McpPattern(carriers=FOUND), 0), *((McpPattern(carriers=CHOSEN, codes=WORDS), seed) for seed in range(3))],
)
def test_harmonics_of_print_are_no_carriers_of_wider_pixels(pattern, seed):
    frame, sequence, truth, calibration = seen(pattern, seed)
    off = np.abs(decoded(frame, sequence, calibration).rows - truth.rows)
    assert np.isfinite(off).mean() > 0.6
    assert np.nanpercentile(off, 99.9) < pattern.pitch_px(sequence.projector) / 2


def test_a_calibration_tells_the_shape_of_pixels_and_no_codes():
    frame, sequence, _, calibration = seen(McpPattern(carriers=CHOSEN, codes=WORDS), 0)
    other = PatternSequence(sequence.projector, McpPattern(carriers=CHOSEN, codes=tuple(range(16))))
    with pytest.raises(DecodeError, match="codes"):
        decoded(frame, other, calibration)
    # Stripes alone, without carriers, are refused as before.
    plain = np.repeat(frame.astype(float).mean(axis=1, keepdims=True), frame.shape[1], axis=1)
    plain += np.random.default_rng(0).normal(0, 1, frame.shape)
    with pytest.raises(DecodeError):
        decoded(np.clip(np.rint(plain), 0, 255).astype(np.uint8), sequence, calibration)
