"""The reference decoder's maps, on the camera's grid, with values on the marks alone."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.decode import Decoded, Reason
from scanner.decode.mcp.casey2011.code_to_phase import CodeToPhase
from scanner.decode.mcp.casey2011.growth import Marks
from scanner.decode.mcp.casey2011.stripe_detection import Stripes
from scanner.patterns import CameraFormat

_SIGMA_PX = np.array([12**-0.5, 0.5, 1.0, 0.5], np.float32)
"""Error of peaks, mid-levels, minima and mid-levels, camera px: a peak's is that of rounding to whole pixels; a minimum
lies off by about the width of the blur, a mid-level by half of that."""


def maps_of(
    image: NDArray[Any],
    found: Stripes,
    stripe: NDArray[np.int32],
    marks: Marks,
    phase: CodeToPhase,
    camera: CameraFormat,
) -> Decoded:
    """Maps with values on the marks; albedo and modulation over one stripe around every pixel.

    Ours but for the rows (sec. 3.7): the dissertation goes from codes to points without maps of anything else.

    Args:
        image: (H, W), stripes horizontal.
        found: its stripes.
        stripe: (P,) stripe index of each peak, -1 none.
        marks: peaks, minima and mid-levels with a name.
        phase: their rows.
        camera: format of `image`.
    """
    shape = found.region.shape
    high = 2 * round(found.wavelength / 2) + 1
    at = marks.y, marks.x
    rows = np.full(shape, np.nan, np.float32)
    row = phase.rows(marks.index)
    rows[at] = row
    sigma = np.full(shape, np.nan, np.float32)
    sigma[at] = np.float32(phase.slope / found.wavelength) * _SIGMA_PX[np.rint(4 * (marks.index % 1)).astype(np.intp)]
    confidence = np.zeros(shape, np.float32)
    confidence[at] = marks.confidence
    upper = cv2.dilate(image, np.ones((high, 1), np.uint8)).astype(np.float32)
    lower = cv2.erode(image, np.ones((high, 1), np.uint8)).astype(np.float32)
    albedo = cv2.boxFilter(image, cv2.CV_32F, (1, high))
    named = np.full(shape, -1, np.int16)
    peaks = found.peaks
    named[peaks.y, peaks.column] = stripe
    reason = np.where(upper > found.threshold, np.uint8(Reason.BORDER), np.uint8(Reason.SHADOW))
    reason[peaks.y, peaks.column] = Reason.UNWRAP_RISK
    reason[image >= camera.max_value] = Reason.CLIPPED
    reason[at] = Reason.VALUE
    listed = np.stack([marks.x, marks.y, row, marks.index, marks.confidence], axis=1).astype(np.float32)
    return Decoded(
        rows=rows,
        columns=None,
        sigma_rows=sigma,
        sigma_columns=None,
        confidence=confidence,
        albedo=np.asarray(albedo, np.float32),
        modulation=np.asarray(upper - lower, np.float32),
        reason=reason,
        stripes=named,
        peaks=listed,
    )
