"""Writing a scan's folder (formats.md, Scan): points first, then the other maps, the cloud, the picture, the report.

What is in each file is its own module's: `npz`, `ply`, `preview`. Here is what is written when. scan.npz and cloud.ply
take shape side by side, and what remains to be computed is computed while the disk writes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from mmap import ACCESS_READ, mmap
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.npz import MEMBER_BYTES, NpzWriter
from scanner.ply import VERTEX, write_cloud
from scanner.preview import preview_picture
from scanner.storage import Digests, replace_file, replace_json, replacing, storage_errors

if TYPE_CHECKING:
    from scanner.scan import Scan

Progress = Callable[[str], None]
"""Told the name of each file as it is written whole."""

Draw = Callable[["Scan"], NDArray[np.uint8]]

SCAN_FILE, CLOUD_FILE = "scan.npz", "cloud.ply"
FILES = ("report.json", "error_map.png", "preview.png", CLOUD_FILE, SCAN_FILE)
"""Of a scan, in the order in which an older one's are removed: without a report it is not whole"""

_BOTH = f"write {SCAN_FILE} and {CLOUD_FILE}"
_HEADER_ROOM = 4096


@dataclass(frozen=True)
class ArrayPlace:
    """Where in scan.npz an array is: C-contiguous, little-endian, from this byte on."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    offset: int
    bytes: int


class ScanWriter:
    """A scan's folder while it is written: `points` at once where somebody waits for them, then `write`.

    Used in a `with` statement; left before `write` has ended, it leaves whole files and no report.
    """

    def __init__(self, folder: Path, digests: Digests | None = None) -> None:
        """`digests` makes the SHA-256 of each file, by its name."""
        self._folder = folder
        self._digests = digests
        self._open = ExitStack()
        self._npz: NpzWriter | None = None
        self._there: dict[str, NDArray[Any]] = {}
        self._timings: dict[str, float] = {}
        self._written: list[str] = []

    def __enter__(self) -> Self:
        """Make the folder and remove the files of an earlier scan.

        Raises:
            StorageError: the folder cannot be written.
        """
        with storage_errors(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
            for name in FILES:
                (self._folder / name).unlink(missing_ok=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        abandoned = error or RuntimeError("the scan was not written to its end")
        self._open.__exit__(type(abandoned), abandoned, trace)

    def points(self, xyz: NDArray[np.float32], confidence: NDArray[np.float32]) -> tuple[ArrayPlace, ...]:
        """Begin scan.npz with these two, which `write` must then be given in the scan; returns where they are.

        They are in the file's temporary name (`storage.temporary_of`) when this returns, for all who read on this
        machine, and last with the whole file.

        Raises:
            StorageError: the disk is full, or the folder cannot be written.
        """
        with self._timed(_BOTH):
            # As many maps as there may be: what is too much is given back.
            npz = self._begin_npz(xyz.nbytes + 9 * confidence.nbytes)
            first = (("xyz", xyz), ("confidence", confidence))
            return tuple(self._add(npz, name, array, now=True) for name, array in first)

    def write(self, scan: Scan, progress: Progress | None = None) -> tuple[str, ...]:
        """Write all files, each whole; report.json last. Returns their names, of which `progress` is told in order.

        Raises:
            StorageError: the folder cannot be written.
        """
        self._timings |= scan.report.get("timings", {}) | self._timings
        warnings = list(scan.report.get("warnings", ()))
        with self._timed(_BOTH), ThreadPoolExecutor(1, thread_name_prefix="cloud") as beside:
            cloud = beside.submit(self._write_cloud, scan) if scan.xyz is not None and scan.valid.any() else None
            self._write_arrays(scan)
            self._tell(SCAN_FILE, progress)
            self._wait_for(cloud, progress)
        if cloud is None:
            warnings.append(_without_cloud(scan))
        self._write_picture("preview.png", preview_picture, scan, progress)
        if scan.error_map is not None:
            self._write_picture("error_map.png", _error_map, scan, progress)
        with self._timed("write report.json"):
            report = {**scan.report, "timings": self._timings, "warnings": warnings}
            replace_json(self._folder / "report.json", report, self._digests)
        self._tell("report.json", progress)
        return tuple(self._written)

    def _begin_npz(self, room: int) -> NpzWriter:
        path = self._folder / SCAN_FILE
        file = self._open.enter_context(replacing(path, self._digests, room=room + 16 * MEMBER_BYTES))
        self._npz = NpzWriter(file)
        return self._npz

    def _add(self, npz: NpzWriter, name: str, array: NDArray[Any], *, now: bool = False) -> ArrayPlace:
        self._there[name] = array
        return ArrayPlace(name, array.dtype.str, array.shape, npz.add(name, array, now=now), array.nbytes)

    def _write_arrays(self, scan: Scan) -> None:
        arrays = scan.arrays()
        with self._timed(f"write {SCAN_FILE}"):
            npz = self._npz or self._begin_npz(sum(array.nbytes for array in arrays.values()))
            for name, array in arrays.items():
                if name not in self._there:
                    self._add(npz, name, array)
                elif not np.shares_memory(self._there[name], array):
                    raise AssertionError(f"{name} was written before it was what it is")
            npz.close()
            self._open.close()

    def _write_cloud(self, scan: Scan) -> None:
        normals = scan.normals
        assert scan.xyz is not None  # noqa: S101  only called with points
        assert normals is not None  # noqa: S101
        room = int(np.count_nonzero(scan.valid)) * VERTEX.itemsize + _HEADER_ROOM
        path = self._folder / CLOUD_FILE
        with self._timed(f"write {CLOUD_FILE}"), replacing(path, room=room) as file:
            comments = ("fringed; mm, camera frame: x right, y down, z forward",)
            write_cloud(file, scan.xyz, normals, scan.albedo, scan.confidence, comments)
        if self._digests is not None:
            with path.open("rb") as written:  # of the file: the buffer it was written from holds its last part alone
                content = mmap(written.fileno(), 0, access=ACCESS_READ)
            self._digests.begin(CLOUD_FILE, [content])

    def _write_picture(self, name: str, draw: Draw, scan: Scan, progress: Progress | None) -> None:
        with self._timed(f"write {name}"):
            replace_file(self._folder / name, _png(draw(scan)), self._digests)
        self._tell(name, progress)

    def _wait_for(self, cloud: Future[None] | None, progress: Progress | None) -> None:
        if cloud is not None:
            cloud.result()
            self._tell(CLOUD_FILE, progress)

    def _tell(self, name: str, progress: Progress | None) -> None:
        self._written.append(name)
        if progress is not None:
            progress(name)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self._timings[stage] = round(self._timings.get(stage, 0.0) + time.perf_counter() - begin, 6)


def _without_cloud(scan: Scan) -> str:
    if scan.xyz is None:
        return (
            "without a calibration there are rows or columns, and no points: "
            "name one with --calibration, or in the rig file"
        )
    removed = {name: count for name, count in (scan.report.get("removed") or {}).items() if count}
    why = ""
    if removed:
        most = max(removed, key=lambda name: removed[name])
        what = {"depth": "lay outside --depth", "box": "lay outside --box", "impossible": "had no depth on this rig"}
        why = f": {removed[most]:,} of them {what.get(most, f'fell to the filter for {most}')}"
    return f"the cloud has no points, and cloud.ply was not written{why}"


def _error_map(scan: Scan) -> NDArray[np.uint8]:
    return np.asarray(scan.error_map, np.uint8)


def _png(picture: NDArray[np.uint8]) -> bytes:
    # Level 1 costs a tenth of the default's time and a few per cent in size on such pictures.
    _, content = cv2.imencode(".png", picture, (cv2.IMWRITE_PNG_COMPRESSION, 1))
    return content.tobytes()
