"""Uncompressed .npz files: NumPy's own format, without copies on the way out or trust on the way in.

`numpy.load(path, allow_pickle=False)` reads what is written here. Reading checks every member's dtype and its size
against its header before a byte of it is decoded.
"""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from scanner.errors import StorageError
from scanner.storage import Written

MAX_BYTES = 4 << 30
"""Of one array: a scan of a 100-megapixel camera stays below it."""


ALIGNED_BYTES = 64
"""Arrays begin at multiples of it in the file, as they do in a .npy: a reader may map them where they lie."""

_ALIGNMENT_FIELD = 0xD935
"""Of a member's extra field: its first two bytes are the alignment, the others fill up (Android's zipalign has it)"""

MEMBER_BYTES = 512
"""Around each array at most: two headers of the archive and one of the array."""


class NpzWriter:
    """An uncompressed .npz, written from front to back, array after array; the same arrays give the same bytes."""

    def __init__(self, file: BinaryIO) -> None:
        """`file` is empty, and stays open."""
        self._file = file
        self._members: list[zipfile.ZipInfo] = []
        self._unsummed: list[tuple[zipfile.ZipInfo, bytearray, memoryview]] = []

    def add(self, name: str, array: NDArray[Any], *, now: bool = False) -> int:
        """Write an array; returns where in the file its first byte is, C-contiguous from there on.

        Args:
            name: in the archive, without the ending.
            array: does not change until the file is closed.
            now: somebody waits for the bytes: the checksum is made, and written before them, by `close`. The file is
                one of `storage.replacing`.
        """
        solid = np.ascontiguousarray(array)
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(header, np.lib.format.header_data_from_array_1_0(solid))
        return self._append(f"{name}.npy", header.getvalue(), bytes_of(solid), now=now)

    def close(self) -> None:
        """Write the list of members."""
        for info, head, content in self._unsummed:
            info.CRC = zlib.crc32(content, zlib.crc32(head[len(info.FileHeader()) :]))
            head[: len(info.FileHeader())] = info.FileHeader()
            cast(Written, self._file).rewrite(head, info.header_offset)
        with zipfile.ZipFile(self._file, "w", zipfile.ZIP_STORED) as archive:
            archive.filelist = self._members
            archive._didModify = True  # type: ignore[attr-defined]

    def _append(self, name: str, header: bytes, content: memoryview, *, now: bool) -> int:
        """A member whose checksum stands in its header from the start: zipfile would go back to write it later."""
        file = self._file
        info = zipfile.ZipInfo(name)  # dated 1980, whatever the clock says
        info.external_attr = 0o644 << 16
        info.header_offset = file.tell()
        info.file_size = info.compress_size = len(header) + len(content)
        info.CRC = 0 if now else zlib.crc32(content, zlib.crc32(header))
        info.extra = _filling(info.header_offset + len(info.FileHeader()) + len(header))
        head = bytearray(info.FileHeader() + header)
        if now:
            self._unsummed.append((info, head, content))
        file.write(head)
        first = file.tell()
        file.write(content)
        self._members.append(info)
        return first


def _filling(first: int) -> bytes:
    """An extra field that moves what would begin at byte `first` to the next multiple of ALIGNED_BYTES."""
    length = -first % ALIGNED_BYTES
    if not length:
        return b""
    length += ALIGNED_BYTES if length < 6 else 0  # the field's own head
    return struct.pack("<HHH", _ALIGNMENT_FIELD, length - 4, ALIGNED_BYTES).ljust(length, b"\0")


def write_npz(file: BinaryIO, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as an uncompressed .npz."""
    npz = NpzWriter(file)
    for name, array in arrays.items():
        npz.add(name, array)
    npz.close()


def read_npz(path: Path, dtypes: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Read the members that `dtypes` names, as far as they are there; others are ignored.

    Raises:
        StorageError: unreadable, damaged, compressed, or a member of another dtype or of a size that is not its own.
    """
    arrays: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist():
                name = info.filename.removesuffix(".npy")
                if name in dtypes:
                    arrays[name] = _read(archive, info, np.dtype(dtypes[name]), f"{path}: {name}")
    except FileNotFoundError as error:
        raise StorageError(f"{path} is not there", hint="a scan's folder holds scan.npz") from error
    except OSError as error:
        raise StorageError(f"cannot read {path}: {error.strerror or error}") from error
    except (zipfile.BadZipFile, EOFError, ValueError, RuntimeError, NotImplementedError) as error:
        raise StorageError(f"{path} is damaged: {error}") from error
    return arrays


def bytes_of(array: NDArray[Any]) -> memoryview:
    """The bytes of a C-contiguous array, not copied."""
    if array.size == 0:
        return memoryview(bytearray())
    return array.reshape(-1).view(np.uint8).data


def _read(archive: zipfile.ZipFile, info: zipfile.ZipInfo, dtype: np.dtype[Any], name: str) -> NDArray[Any]:
    if info.compress_type != zipfile.ZIP_STORED or info.file_size > MAX_BYTES:
        raise StorageError(f"{name} is compressed or larger than {MAX_BYTES >> 30} GiB", hint="write it uncompressed")
    with archive.open(info) as member:
        version = np.lib.format.read_magic(member)
        if version != (1, 0):
            raise StorageError(f"{name} has version {version} of the .npy format, this program reads (1, 0)")
        shape, fortran, found = np.lib.format.read_array_header_1_0(member)
        if found != dtype or fortran:
            raise StorageError(f"{name} holds {found}{' in Fortran order' if fortran else ''}, expected {dtype}")
        expected = int(np.prod(shape, dtype=object)) * dtype.itemsize
        if info.file_size - member.tell() != expected:
            raise StorageError(f"{name} has {info.file_size - member.tell()} bytes, its header says {expected}")
        array = np.empty(shape, dtype)
        # To the end: there the member's checksum is compared.
        bytes_of(array)[:] = member.read()
    return array
