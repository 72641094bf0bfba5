"""Print that makes lines beside the carriers: the search must not take them for a projector of other pixels."""

from __future__ import annotations

import numpy as np

from drivers.registry import open_camera, open_projector
from scanner.clock import VirtualClock
from scanner.decode import decoder_for
from scanner.devices import CameraSettings, TriggerMode
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, ProjectorSize
from scanner.patterns.sequence import Precorrection


def test_harmonics_of_print_are_no_carriers_of_wider_pixels():
    clock = VirtualClock()
    camera, projector = (
        open_("simulated", "quick/two_albedo?seed=0", {}, clock) for open_ in (open_camera, open_projector)
    )
    size = ProjectorSize(projector.capabilities.width, projector.capabilities.height)
    pattern = McpPattern(carriers=(23.0, 32.0, 44.0, 53.0))
    sequence = PatternSequence(size, pattern, precorrection=Precorrection(gamma=2.3))
    camera.apply(CameraSettings(exposure_ns=33_333_333))
    projector.load([sequence.image(0)])
    camera.start(TriggerMode.SOFTWARE)
    projector.show(0)
    clock.sleep_until(clock.now_ns() + 100_000_000)
    camera.trigger()
    frame = camera.pop(1_000_000_000).pixels.copy()
    truth, calibration = camera.truth(), camera.true_calibration()
    camera.close()
    projector.close()
    decoder = decoder_for(sequence, CameraFormat(*frame.shape[::-1]), calibration=calibration)
    decoder.add(0, frame)
    off = np.abs(decoder.finish().rows - truth.rows)
    assert np.isfinite(off).mean() > 0.6
    assert np.nanpercentile(off, 99.9) < pattern.pitch_px(size) / 2
