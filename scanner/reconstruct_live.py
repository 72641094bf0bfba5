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
from scanner.decode import Decoded, Decoder, PositionsDecoder, SeriesDecoder, decoder_for
from scanner.decode_options import DecodeOptions, require_sizes
from scanner.devices import Pixels
from scanner.errors import CalibrationError, DecodeError
from scanner.geometry import Calibration
from scanner.kernel import kernel
from scanner.patterns import Axis, McpPattern
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
        return self._given(frame).finish()

    def result(self, frame: Pixels) -> LiveResult:
        """One frame to what is published.

        Raises:
            DecodeError: it shows no pattern, or another one.
        """
        if self._xyz and self._calibration is not None:
            decoded = self.decode(frame)
            xyz = filtered_points(decoded, self._calibration, self._options.filters).xyz
            count = int(np.count_nonzero(~np.isnan(xyz[..., 2])))
            return LiveResult(np.ascontiguousarray(xyz[:: self._stride, :: self._stride]), count)
        return LiveResult(*quantised(self._positions(frame), self.scale))

    def scan(self, frame: Pixels) -> Scan:
        """One frame to a whole scan, as decoding a capture gives it; for recordings.

        Raises:
            DecodeError: it shows no pattern, or another one.
            CalibrationError: the rig cannot triangulate this pattern's axis.
        """
        return build_scan(self.decode(frame), self._calibration, self._options.filters)

    def _given(self, frame: Pixels) -> Decoder:
        """The decoder, which has been given this frame alone."""
        if self._used:
            if self._follow and isinstance(self._decoder, SeriesDecoder):
                self._decoder.next_frame()
            else:
                self._decoder = self._new_decoder()
        self._used = True
        self._decoder.add(0, frame)
        return self._decoder

    def _positions(self, frame: Pixels) -> Map:
        decoder = self._given(frame)
        if isinstance(decoder, PositionsDecoder):
            return decoder.positions()
        decoded = decoder.finish()
        rows = decoded.rows if self.axis == "y" else decoded.columns
        if rows is None:
            raise AssertionError("an MCP decoder gives the axis of its pattern")
        return rows

    def _new_decoder(self) -> Decoder:
        fit = None if self._calibration is None else self._calibration.extra.get("mcp_phase")
        return decoder_for(
            self._header.sequence,
            self._header.camera,
            self._options.decoder,
            mcp_phase=fit,
            calibration=self._calibration,
        )


def row_scale(length: int) -> float:
    """Steps a projector pixel that fit into 16 bits: floor(65535 / L) (formats.md, Wire)."""
    return float(LARGEST // length)


def quantised(rows: Map, scale: float) -> tuple[NDArray[np.uint16], int]:
    """Rows for the wire, and how many there are.

    Args:
        rows: (H, W) float32 px, NaN = none.
        scale: steps a pixel.

    Returns:
        (H, W) uint16, round((row + 0.5) * scale) within 1 .. 65535, 0 = none; number of values that are not 0.
    """
    values = np.empty(rows.shape, np.uint16)
    count = _quantise(np.ascontiguousarray(rows).reshape(-1), np.float32(scale), values.reshape(-1))
    return values, int(count)


@kernel
def _quantise(rows: Map, scale: np.float32, values: NDArray[np.uint16]) -> int:
    missing = 0
    for i in range(len(rows)):
        value = (rows[i] + np.float32(0.5)) * scale + np.float32(0.5)
        # A value is never 0, which means none.
        none = value != value  # noqa: PLR0124  (NaN alone differs from itself)
        whole = np.int32(min(max(value, np.float32(1)), np.float32(LARGEST)))
        values[i] = np.uint16(np.int32(0) if none else whole)
        missing += none
    return len(rows) - missing


def warm_up() -> None:
    """Compile the kernel."""
    quantised(np.zeros((2, 2), np.float32), 1.0)
