"""One scan in the worker: frames of its series in, files out.

Frames are mapped from the spool, checked against their digests, and given to `scanner.reconstruct` as they come. The
scan is made as soon as all that are decoded are there, while the sentinels behind them are exposed; with the last one
it is known whether all are in step, and where the points are is said, of so many frames. Everything else is told when
the series has ended, and frames that are taken again make it void.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError
from scanner.scan_report import read_report
from scanner.storage import Digests, prepare_output, remove_empty
from scanner.stream import Ack, DecodedNote, End, Frame, FromWorker, PointsNote, Progress, Result, Start
from scanner.wire import ArrayEntry, FileEntry
from service.series import file_entry
from service.spool import CAPTURE

if TYPE_CHECKING:
    from scanner.capture import Capture, CaptureHeader
    from scanner.reconstruct import Reconstruction
    from scanner.scan import Map, Scan
    from scanner.scan_files import ScanWriter

ACK_EVERY = 4
"""Frames between two acknowledgements: a sixteenth of the credit."""

_log = logging.getLogger(__name__)


class ScanWork:
    """One series' life in the worker: `begin`, `frame` for each, `end`; and `close`, however it ended."""

    def __init__(
        self, start: Start, answer: Callable[[FromWorker], None], check: Callable[[int], None], *, decode: bool
    ) -> None:
        """`answer` does not block; `check` raises where the series was cancelled."""
        self.delivery = start.delivery
        self._start = start
        self._check = check
        self._decode = decode
        self._words = _Words(answer, start.delivery)
        self._folder = Path(start.capture)
        self._output = Path(start.output)
        self._header: CaptureHeader
        self._reconstruction: Reconstruction | None = None
        self._frames: _MappedFrames
        self._taken = 0
        self._slots: dict[int, int] = {}
        """of the frames that are here, by pattern"""
        self._digests: dict[int, str] = {}
        """of slots whose pixels were checked"""
        self._retaken = False
        self._writing = ExitStack()
        self._writer: ScanWriter | None = None
        self._arrays: list[ArrayEntry] = []
        """of the points that are in scan.npz"""

    def begin(self) -> None:
        """Read capture.json, make ready."""
        from scanner.capture import Capture  # noqa: PLC0415  (OpenCV and Numba come in while devices open)

        capture = Capture.open(self._folder)
        self._header = capture.header
        self._frames = _MappedFrames(self._header)
        if self._decode:
            from scanner.decode_options import DecodeOptions  # noqa: PLC0415
            from scanner.reconstruct import Reconstruction, calibration_for  # noqa: PLC0415

            options = DecodeOptions.from_dict(self._start.options)
            self._reconstruction = Reconstruction(self._header, calibration_for(capture), options)

    def frame(self, message: Frame) -> None:
        """Take one frame; one whose pixels are not those that were written is missing, here as to later readers.

        Raises:
            DecodeError: the spool cannot be read.
        """
        self._taken += 1
        pixels = None
        if message.slot is not None and message.status == "ok":
            pixels = self._frames.at(message)
        if self._reconstruction is not None:
            if self._slots.pop(message.pattern, None) is not None:
                self._give_up_early()
            if pixels is not None and message.slot is not None:
                self._reconstruction.add(message.pattern, pixels, message.slot, stays=True)
                self._slots[message.pattern] = message.slot
                if message.xxh3 is not None:
                    self._digests[message.slot] = message.xxh3
        if self._taken % ACK_EVERY == 0:
            self._words.say(Ack(self.delivery, self._taken))
        if self._reconstruction is not None:
            self._go_ahead(self._reconstruction, message.pattern)

    def heard(self, end: End) -> None:
        """The series has ended, and this message waits its turn: nothing has to be kept back. From another thread."""
        if end.reason == "completed" and not end.missing:
            self._words.may_tell(end.frames)

    def end(self, message: End) -> FromWorker:
        """Make the scan and its files, or what of them is left to make.

        Raises:
            ScannerError: the frames cannot become a scan, or the disk is full.
        """
        self._words.say(Ack(self.delivery, self._taken))
        self._frames.close()
        if self._taken != message.frames:
            raise DecodeError(f"{message.frames} frames were sent and {self._taken} came")
        if self._reconstruction is None:
            return Result(self.delivery, [], {"frames": self._taken})
        return self._files(self._scan(message))

    def close(self) -> None:
        """Leave nothing half-written. May be called twice."""
        self._arrays, self._writer = [], None
        self._writing.close()

    # --- the scan -----------------------------------------------------------------------------------------------

    def _go_ahead(self, reconstruction: Reconstruction, pattern: int) -> None:
        """Do what can be done with the frames so far: nothing is told of it yet, not even its failure."""
        if len(self._slots) == self._header.frame_count:
            self._words.keep_back(self._taken)
            reconstruction.check(self._capture(), self._stage, self._put_points, self._tell_points)
            return
        if not self._retaken and reconstruction.may_be_solved:
            self._words.keep_back(None)
            reconstruction.solve(self._capture(), self._stage, self._put_points)
        reconstruction.listen(pattern)

    def _give_up_early(self) -> None:
        """A frame was taken again: what was made without it is void, and the rest waits for the last one."""
        self._retaken = True
        self._words.forget()
        self.close()

    def _capture(self) -> Capture:
        from scanner.capture import Capture  # noqa: PLC0415

        return Capture.open(self._folder, self._digests)

    def _scan(self, message: End) -> Scan:
        from scanner.capture import Capture, close_interrupted  # noqa: PLC0415

        if message.reason == "daemon_restarted" and Capture.open(self._folder).header.state == "open":
            close_interrupted(self._folder, "failed", message.reason)
        capture = self._capture()
        present = {pattern: record.slot for pattern, record in capture.records.items()}
        if present != self._slots:
            self._give_up_early()
        self._words.tell_all()
        if self._reconstruction is None:
            raise AssertionError("begin made it")
        return self._reconstruction.finish(capture, self._stage, self._put_points, self._tell_points)

    # --- files --------------------------------------------------------------------------------------------------

    def _begin_files(self) -> ScanWriter:
        from scanner.scan_files import ScanWriter  # noqa: PLC0415

        if self._writer is None:
            self._writing.callback(remove_empty, [prepare_output(self._output, force=True)])
            self._digests_of = self._writing.enter_context(Digests())
            self._writer = self._writing.enter_context(ScanWriter(self._output, self._digests_of))
        return self._writer

    def _put_points(self, xyz: Map, confidence: Map) -> None:
        if self._arrays:
            self.close()  # those of frames that were taken again since
        places = self._begin_files().points(xyz, confidence)
        self._arrays = [ArrayEntry(p.name, p.dtype, p.shape, p.offset, p.bytes) for p in places]

    def _tell_points(self) -> None:
        if self._arrays:
            self._words.say(PointsNote(self.delivery, self._arrays, self._taken))

    def _files(self, scan: Scan) -> Result:
        began = time.perf_counter()
        writer = self._begin_files()
        entries: list[FileEntry] = []

        def written(name: str) -> None:
            entries.append(file_entry(self._output, name, sha=self._digests_of.of(name)))
            if name == "scan.npz":
                self._words.tell(DecodedNote(self.delivery, list(entries), _short(scan.report)))
            self._stage(f"wrote {name}")

        self._stage("writing files")
        writer.write(scan, written)
        self.close()
        capture = sorted(path.name for path in self._folder.iterdir() if path.is_file() and path.name[0] != ".")
        entries += [file_entry(self._folder, name, f"{CAPTURE}/{name}") for name in capture]
        _log.info("delivery %d: files written in %.2f s", self.delivery, time.perf_counter() - began)
        # As it was written: what JSON cannot say was refused there, and not by the socket.
        return Result(self.delivery, entries, read_report(self._output / "report.json"))

    def _stage(self, name: str) -> None:
        self._check(self.delivery)
        self._words.tell(Progress(self.delivery, name))


class _Words:
    """What is said of a series. While a scan is made early, what it tells is kept back until the series has ended."""

    def __init__(self, answer: Callable[[FromWorker], None], delivery: int) -> None:
        self._answer = answer
        self._delivery = delivery
        self._lock = threading.Lock()
        self._early: int | None = None
        """frames that the scan is made of"""
        self._back = False
        self._kept: list[FromWorker] = []
        self._frames: int | None = None
        """of a series that has ended well"""

    def say(self, message: FromWorker) -> None:
        """Say something at once."""
        self._answer(message)

    def tell(self, message: FromWorker) -> None:
        """Say what follows from the frames."""
        with self._lock:
            if self._back and (self._early is None or self._early != self._frames):
                self._kept.append(message)
            else:
                self._answer(message)

    def keep_back(self, frames: int | None) -> None:
        """From now on, unless the series has ended with so many frames; None: it cannot have ended yet."""
        with self._lock:
            self._back, self._early = True, frames
            if frames is not None and frames == self._frames:
                self._tell_kept()

    def forget(self) -> None:
        """What was kept back is void."""
        with self._lock:
            self._kept = []

    def may_tell(self, frames: int) -> None:
        """The series has ended well with so many frames: if these are all that there were, what was kept is told."""
        with self._lock:
            self._frames = frames
            if self._early == frames:
                self._tell_kept()

    def tell_all(self) -> None:
        """The series has ended: nothing is kept back any more."""
        with self._lock:
            self._back = False
            self._tell_kept()

    def _tell_kept(self) -> None:
        for message in self._kept:
            self._answer(message)
        self._kept = []


class _MappedFrames:
    """Frames of one series, mapped from the spool and checked. One map serves until the file has grown beyond it."""

    def __init__(self, header: CaptureHeader) -> None:
        self._camera = header.camera
        self._bytes = header.camera.width * header.camera.height * header.camera.dtype.itemsize
        self._map: NDArray[np.uint8] | None = None
        self._path = ""

    def at(self, message: Frame) -> NDArray[Any] | None:
        """A frame's pixels, (H, W), read-only, no copy; None where their digest differs (formats.md, Capture).

        Raises:
            DecodeError: they are not there.
        """
        from scanner.capture import digest_matches  # noqa: PLC0415

        end = message.offset + self._bytes
        if self._map is None or message.path != self._path or len(self._map) < end:
            try:
                self._map = np.memmap(message.path, dtype=np.uint8, mode="r")
            except (OSError, ValueError) as error:
                raise DecodeError(f"cannot map {message.path}: {error}") from error
            self._path = message.path
        if len(self._map) < end:
            raise DecodeError(f"{message.path}: pattern {message.pattern} lies beyond the end of the file")
        pixels = self._map[message.offset : end].view(self._camera.dtype).reshape(self._camera.shape)
        if not digest_matches(pixels, message.xxh3):
            _log.warning("%s: the digest of pattern %d differs: taken as missing", message.path, message.pattern)
            return None
        return pixels

    def close(self) -> None:
        """Let the file go."""
        self._map = None


def _short(report: Any) -> dict[str, Any]:
    return {key: report[key] for key in ("points", "coverage") if key in report}
