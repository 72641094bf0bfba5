"""A client's side of a live run without any socket: results as arrays, and the order of calls around them.

`scanner.client` wraps it twice. The live socket gives the newest result only (ZMQ_CONFLATE), so nothing is lost by
reading slowly but older results; how the run fares is asked when nothing comes.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanner.errors import ScannerError
from scanner.session import Call
from scanner.wire import TERMINAL_STATES, ErrorBody, error_from_body
from scanner.wire_images import LiveHeader, decode_live

if TYPE_CHECKING:
    from scanner.geometry import Calibration

Map = NDArray[np.float32]

QUIET_S = 0.5
"""After this long without a result the client asks how the run fares."""


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """One camera frame's result. Arrays are read-only views of the message where that is possible."""

    header: LiveHeader
    values: NDArray[Any]
    """as sent: (h, w) uint16 rows or columns, or (h, w, 3) float32 mm"""
    missed: int
    """results and frames between this one and the one before that this client did not get"""

    @property
    def number(self) -> int:
        """Of the camera frame, from 0."""
        return self.header.number

    @property
    def error(self) -> str | None:
        """Why this frame gave nothing; else None."""
        return self.header.error

    @property
    def latency_ms(self) -> float:
        """From the end of the exposure to when the result was given to the socket."""
        return (self.header.sent_ns - self.header.end_ns) / 1e6

    @cached_property
    def rows(self) -> Map | None:
        """(H, W) float32 projector rows, px, NaN = none; None where columns or points were asked for, or on `error`."""
        return self._positions("rows")

    @cached_property
    def columns(self) -> Map | None:
        """(H, W) float32 projector columns, px; see `rows`."""
        return self._positions("columns")

    @property
    def xyz(self) -> Map | None:
        """(h, w, 3) float32 mm, camera frame, NaN = none; None where rows were asked for, or on `error`."""
        return self.values if self.header.content == "xyz" and self.error is None else None

    def points(self, calibration: Calibration) -> Map:
        """(H, W, 3) float32 mm: the rows or columns triangulated here, unfiltered; xyz as it came.

        Raises:
            CalibrationError: it is of another rig, or this axis measures no depth on it.
        """
        from scanner.triangulation import triangulate  # noqa: PLC0415  (brings kernels; not every client wants points)

        if self.header.content == "xyz":
            return np.asarray(self.values, dtype=np.float32)
        return triangulate(calibration, rows=self.rows, columns=self.columns).xyz

    def _positions(self, content: str) -> Map | None:
        if self.header.content != content or self.error is not None:
            return None
        rows = self.values.astype(np.float32)
        rows /= np.float32(self.header.scale)
        rows -= np.float32(0.5)
        rows[self.values == 0] = np.nan
        return rows


class LiveWatch:
    """Follows one live run through its results and, where none come, through its state.

    Feed `result` with messages; after `QUIET_S` without one ask `live.status` and feed `state`. `finished` is set once
    the run is over.
    """

    def __init__(self, job_id: str) -> None:
        self.job_id = job_id
        self.finished = False
        self.missed = 0
        """results and frames that this client did not get, in all"""
        self._last = -1

    def result(self, data: bytes) -> LiveFrame | None:
        """A message of the live socket; None where it is another run's, or older than the last one.

        Raises:
            ProtocolError: it is no result.
        """
        header, values = decode_live(data)
        if header.job != self.job_id or header.number <= self._last:
            return None
        missed = header.number - self._last - 1
        self._last = header.number
        self.missed += missed
        shape = (header.height, header.width, 3) if header.content == "xyz" else (header.height, header.width)
        dtype = "<f4" if header.dtype == "float32" else "<u2"
        return LiveFrame(header, np.frombuffer(values, dtype).reshape(shape), missed)

    def state(self, status: Mapping[str, Any]) -> None:
        """Take `live.status`.

        Raises:
            ScannerError: the run failed, as its class.
        """
        run = status.get("run")
        if run is None or run["id"] != self.job_id:
            self.finished = True  # another one has begun since: this one is over
            return
        if run["state"] in TERMINAL_STATES:
            self.finished = True
        if run["state"] == "failed":
            raise _failure(run)


def live_start_call(job_id: str | None, params: Mapping[str, Any]) -> Call:
    """The call that starts a live run, with a fresh job id where none is given."""
    given = {key: value for key, value in params.items() if value is not None}
    return Call("live.start", {"job_id": job_id or str(uuid.uuid4()), **given})


def _failure(run: Mapping[str, Any]) -> ScannerError:
    if run.get("error"):
        return error_from_body(msgspec.convert(run["error"], ErrorBody))
    return ScannerError(f"live run {run['id']} failed: {run.get('reason')}")
