"""The worker's working thread: frames in, a scan's files out. Knows no socket.

Frames are mapped from the spool, checked against their digests, and given to `scanner.reconstruct` as they come; what
is left at `end` is the check, the unwrapping and the points.
"""

from __future__ import annotations

import hashlib
import importlib
import logging
import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scanner.errors import DecodeError, ScannerError
from scanner.storage import Digests, prepare_output
from scanner.stream import (
    Ack,
    Cancel,
    DecodedNote,
    End,
    Failed,
    Frame,
    FromWorker,
    LiveBegin,
    LiveFrame,
    Progress,
    Released,
    Result,
    Start,
)
from scanner.wire import FileEntry, error_body
from service.live_work import LiveWork
from service.spool import CAPTURE
from service.warm_up import modules_with_kernels

if TYPE_CHECKING:
    from scanner.capture import CaptureHeader
    from scanner.reconstruct import Reconstruction
    from scanner.scan import Scan

ACK_EVERY = 4
"""Frames between two acknowledgements: a sixteenth of the credit."""

Job = Start | Frame | End | LiveBegin | LiveFrame | Cancel
_log = logging.getLogger(__name__)


class _Cancelled(Exception):
    """Unwinds a series that was cancelled."""


class Work:
    """Series after series."""

    def __init__(self, answer: Callable[[FromWorker], None], *, decode: bool) -> None:
        """`answer` is called in the working thread and must not block."""
        self._answer = answer
        self._decode = decode
        self._cancelled: set[int] = set()
        self._ending = threading.Event()
        self._series: _Series | None = None
        self._live: LiveWork | None = None

    @property
    def idle(self) -> bool:
        """Whether no series and no live run is under way."""
        return self._series is None and self._live is None

    def cancel(self, delivery: int | None) -> None:
        """Let a series go (None: everything) at the next stage. Called from another thread."""
        if delivery is None:
            self._ending.set()
        else:
            self._cancelled.add(delivery)

    def serve(self, jobs: queue.SimpleQueue[Job | None]) -> None:
        """Work until None comes."""
        if self._decode:
            _warm_up()
        try:
            self._serve(jobs)
        finally:
            self._end_live()

    def _serve(self, jobs: queue.SimpleQueue[Job | None]) -> None:
        while (message := jobs.get()) is not None:
            try:
                self._do(message)
            except _Cancelled:
                self._series = None
                self._end_live()
                self._answer(Released(message.delivery))
            except ScannerError as error:
                self._fail(message.delivery, error)
            except Exception as error:  # noqa: BLE001  (a decoder that fails on one capture serves the next)
                _log.exception("decoding failed")
                problem = f"the decoder failed: {type(error).__name__}: {error}"
                self._fail(message.delivery, DecodeError(problem, hint="look at the log for the cause"))

    def _end_live(self) -> None:
        live, self._live = self._live, None
        if live is not None:
            live.close()

    def _fail(self, delivery: int, error: ScannerError) -> None:
        self._series = None
        self._end_live()
        self._answer(Failed(delivery, error_body(error)))

    def _do(self, message: Job) -> None:
        if isinstance(message, Cancel):
            # Whatever has become of it: it was stopped in a stage and answered so, is answered for, or never began.
            self._cancelled.discard(message.delivery)
            under_way = self._live or self._series
            if under_way is None or under_way.delivery == message.delivery:
                raise _Cancelled
        elif isinstance(message, Start):
            self._check(message.delivery)
            self._series = _Series(message, self._answer, self._check, decode=self._decode)
            self._series.begin()
        elif isinstance(message, LiveBegin):
            self._check(message.delivery)
            self._live = LiveWork(message, self._answer)
        elif self._live is not None and self._live.delivery == message.delivery:
            if isinstance(message, LiveFrame):
                self._live.frame(message)
            else:
                self._end_live()
                self._answer(Result(message.delivery, []))
        elif isinstance(message, LiveFrame):
            return  # of a run that is over
        elif self._series is not None and self._series.delivery == message.delivery:
            self._check(message.delivery)
            if isinstance(message, Frame):
                self._series.frame(message)
            else:
                result = self._series.end(message)
                self._series = None
                self._answer(result)

    def _check(self, delivery: int) -> None:
        if delivery in self._cancelled or self._ending.is_set():
            raise _Cancelled


class _Series:
    """One series' life in the worker."""

    def __init__(
        self, start: Start, answer: Callable[[FromWorker], None], check: Callable[[int], None], *, decode: bool
    ) -> None:
        self.delivery = start.delivery
        self._start = start
        self._answer = answer
        self._check = check
        self._decode = decode
        self._folder = Path(start.capture)
        self._header: CaptureHeader
        self._reconstruction: Reconstruction | None = None
        self._frames: _MappedFrames
        self._taken = 0

    def begin(self) -> None:
        """Read capture.json, make ready."""
        from scanner.capture import Capture  # noqa: PLC0415  (OpenCV and Numba come in while devices open)

        capture = Capture.open(self._folder)
        self._header = capture.header
        self._frames = _MappedFrames(self._header)
        if self._decode:
            from scanner.reconstruct import DecodeOptions, Reconstruction, calibration_for  # noqa: PLC0415

            options = DecodeOptions.from_dict(self._start.options)
            self._reconstruction = Reconstruction(self._header, calibration_for(capture), options)

    def frame(self, message: Frame) -> None:
        """Take one frame; one whose pixels are not those that were written is missing, here as to later readers.

        Raises:
            DecodeError: the spool cannot be read.
        """
        if message.slot is not None and message.status == "ok":
            pixels = self._frames.at(message)
            if pixels is not None and self._reconstruction is not None:
                self._reconstruction.add(message.pattern, pixels, message.slot, stays=True)
        self._taken += 1
        if self._taken % ACK_EVERY == 0:
            self._answer(Ack(self.delivery, self._taken))

    def end(self, message: End) -> FromWorker:
        """Make the scan and its files."""
        self._answer(Ack(self.delivery, self._taken))
        self._frames.close()
        if self._taken != message.frames:
            raise DecodeError(f"{message.frames} frames were sent and {self._taken} came")
        if self._reconstruction is None:
            return Result(self.delivery, [], {"frames": self._taken})
        return self._files(self._scan(message))

    def _scan(self, message: End) -> Scan:
        from scanner.capture import Capture, close_interrupted  # noqa: PLC0415

        if message.reason == "daemon_restarted" and Capture.open(self._folder).header.state == "open":
            close_interrupted(self._folder, "failed", message.reason)
        if self._reconstruction is None:
            raise AssertionError("begin made it")
        return self._reconstruction.finish(Capture.open(self._folder), self._stage)

    def _files(self, scan: Scan) -> Result:
        output = prepare_output(Path(self._start.output), force=True)
        began = time.perf_counter()
        entries: list[FileEntry] = []

        def written(name: str) -> None:
            entries.append(file_entry(output, name, sha=digests.of(name)))
            if name == "scan.npz":
                self._answer(DecodedNote(self.delivery, list(entries), _short(scan.report)))
            self._stage(f"wrote {name}")

        self._stage("writing files")
        with Digests() as digests:
            scan.save(output, written, digests)
        capture = sorted(path.name for path in self._folder.iterdir() if path.is_file() and path.name[0] != ".")
        entries += [file_entry(self._folder, name, f"{CAPTURE}/{name}") for name in capture]
        _log.info("delivery %d: files written in %.2f s", self.delivery, time.perf_counter() - began)
        return Result(self.delivery, entries, dict(scan.report))

    def _stage(self, name: str) -> None:
        self._check(self.delivery)
        self._answer(Progress(self.delivery, name))


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


def file_entry(folder: Path, name: str, listed_as: str | None = None, sha: str | None = None) -> FileEntry:
    """A file's name, size and SHA-256 (read from it where it is not known), for the list that clients fetch by."""
    path = folder / name
    if sha is None:
        with path.open("rb") as file:
            sha = hashlib.file_digest(file, "sha256").hexdigest()
    return FileEntry(listed_as or name, path.stat().st_size, sha)


def _short(report: Any) -> dict[str, Any]:
    return {key: report[key] for key in ("points", "coverage") if key in report}


def _warm_up() -> None:
    """Load decoder and kernels while the devices open: the first scan should not wait for imports and caches."""
    began = time.perf_counter()
    for name in modules_with_kernels():
        if name.startswith("scanner."):
            try:
                importlib.import_module(name).warm_up()
            except Exception:  # noqa: BLE001  (one decoder that is broken fails its own scans, and not all others)
                _log.exception("%s could not be made ready", name)
    importlib.import_module("scanner.reconstruct")
    _log.info("decoder ready after %.2f s", time.perf_counter() - began)
