"""Frames of a live run to results, each by itself: decoded, and as rows for the wire or as points.

The stages are those of `scanner.reconstruct` and `scanner.scan`, with the same settings: a recorded frame that is
decoded later gives the same values. What a scan has beside them (normals, report, files) is not made. One decoder
serves one run: what it knows of one frame may help it with the next.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from scanner.capture import CaptureHeader
from scanner.decode import Decoded, Decoder, Reason, SeriesDecoder, decoder_for
from scanner.devices import Pixels
from scanner.errors import CalibrationError, DecodeError
from scanner.geometry import Calibration
from scanner.kernel import kernel
from scanner.patterns import Axis, McpPattern
from scanner.reconstruct import DecodeOptions, require_sizes
from scanner.scan import Map, Scan, build_scan, filtered_points

LARGEST = 65535


@dataclass(frozen=True, eq=False)
class LiveResult:
    """What one frame gave, as it crosses the wire.

    values: rows or columns (H, W) uint16, `round((row + 0.5) * scale)`, 0 = none; or xyz (h, w, 3) float32 mm, camera
    frame, NaN = none, every `stride`-th pixel both ways. points: pixels with a value (xyz: with a point), of all.
    """

    values: NDArray[Any]
    points: int


class LiveReconstruction:
    """The decoding of one live run, frame after frame, in one thread."""

    def __init__(
        self,
        header: CaptureHeader,
        calibration: Calibration | None,
        options: DecodeOptions,
        *,
        xyz: bool = False,
        stride: int = 1,
        follow: bool = True,
    ) -> None:
        """Make ready.

        Args:
            header: what is projected and what the camera gives.
            calibration: the rig's; xyz needs one.
            options: as for a scan.
            xyz: points instead of rows.
            stride: of points.
            follow: whether what one frame taught the decoder (where the pattern is) may help it with the next. False
                decodes each frame as if it were the first: its values then depend on nothing else.

        Raises:
            CalibrationError: another rig's calibration, or none for xyz.
            DecodeError: no such decoder, or a pattern of several images.
        """
        if calibration is not None:
            require_sizes(header, calibration)
        if xyz and calibration is None:
            raise CalibrationError("points need a calibration", hint="take rows, or calibrate the rig")
        self._header = header
        self._calibration = calibration
        self._options = options
        self._xyz = xyz
        self._stride = stride
        self._follow = follow
        self._projector = header.sequence.projector
        pattern = header.sequence.pattern
        if len(header.sequence) != 1 or not isinstance(pattern, McpPattern):
            raise DecodeError("live takes an MCP pattern of one image", hint="others need several frames for one scan")
        self._pattern = pattern
        self._decoder = self._new_decoder()
        self._used = False

    @property
    def axis(self) -> Axis:
        """What is measured: "y" rows, "x" columns."""
        return self._pattern.axis

    @property
    def content(self) -> Literal["rows", "columns", "xyz"]:
        """Of the results: rows, columns or xyz."""
        return "xyz" if self._xyz else "rows" if self.axis == "y" else "columns"

    @property
    def scale(self) -> float:
        """Of rows and columns; 0 for xyz."""
        return 0.0 if self._xyz else row_scale(self._projector.along(self.axis))

    def decode(self, frame: Pixels) -> Decoded:
        """One frame, (H, W) uint8 or uint16, to maps.

        Raises:
            DecodeError: it shows no pattern, or another one.
        """
        if self._used:
            if self._follow and isinstance(self._decoder, SeriesDecoder):
                self._decoder.next_frame()
            else:
                self._decoder = self._new_decoder()
        self._used = True
        self._decoder.add(0, frame)
        return self._decoder.finish()

    def result(self, frame: Pixels) -> LiveResult:
        """One frame to what is published.

        Raises:
            DecodeError: it shows no pattern, or another one.
        """
        decoded = self.decode(frame)
        if self._xyz and self._calibration is not None:
            xyz = filtered_points(decoded, self._calibration, self._options.filters).xyz
            count = int(np.count_nonzero(~np.isnan(xyz[..., 2])))
            return LiveResult(np.ascontiguousarray(xyz[:: self._stride, :: self._stride]), count)
        rows = decoded.rows if self.axis == "y" else decoded.columns
        if rows is None:
            raise AssertionError("an MCP decoder gives the axis of its pattern")
        return LiveResult(quantised(rows, self.scale), int(np.count_nonzero(decoded.reason == Reason.VALUE)))

    def scan(self, frame: Pixels) -> Scan:
        """One frame to a whole scan, as decoding a capture gives it; for recordings.

        Raises:
            DecodeError: it shows no pattern, or another one.
            CalibrationError: the rig cannot triangulate this pattern's axis.
        """
        return build_scan(self.decode(frame), self._calibration, self._options.filters)

    def _new_decoder(self) -> Decoder:
        return decoder_for(self._header.sequence, self._header.camera, self._options.decoder)


def row_scale(length: int) -> float:
    """Steps a projector pixel that fit into 16 bits: floor(65535 / L) (formats.md, Wire)."""
    return float(LARGEST // length)


def quantised(rows: Map, scale: float) -> NDArray[np.uint16]:
    """Rows, (H, W) float32 px, NaN = none, to (H, W) uint16: round((row + 0.5) * scale) within 1 .. 65535, 0 = none."""
    values = np.empty(rows.shape, np.uint16)
    _quantise(np.ascontiguousarray(rows), np.float32(scale), values)
    return values


@kernel
def _quantise(rows: Map, scale: np.float32, values: NDArray[np.uint16]) -> None:
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            value = (rows[i, j] + np.float32(0.5)) * scale + np.float32(0.5)
            # A value is never 0, which means none.
            missing = np.isnan(value)
            values[i, j] = 0 if missing else np.uint16(min(max(value, np.float32(1)), np.float32(65535)))


def warm_up() -> None:
    """Compile the kernel."""
    quantised(np.zeros((2, 2), np.float32), 1.0)
