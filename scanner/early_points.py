"""Points of a scan whose files are still being written: what a client asks for when the daemon says `points`."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanner.errors import ProtocolError
from scanner.session import Call, Procedure
from scanner.wire import MAX_FETCH_BYTES, ArrayEntry, Event

AT_ONCE = 8
"""Pieces that are asked for together: 32 MiB on their way, the points of a megapixel"""


def fetch_arrays(event: Event) -> Procedure[dict[str, NDArray[Any]]]:
    """The arrays that a `points` event names, by name: xyz and confidence, as scan.npz will have them.

    Raises:
        ProtocolError: it is no such event, or arrays and bytes do not fit each other.
    """
    try:
        entries = msgspec.convert(event.fields["arrays"], list[ArrayEntry])
        arrays = {entry.name: np.empty(entry.shape, entry.dtype) for entry in entries}
        name = str(event.fields["file"])
    except (KeyError, TypeError, ValueError, MemoryError) as error:
        raise ProtocolError(f"the event {event.kind!r} names no arrays: {error}") from error
    for entry in entries:
        array = arrays[entry.name]
        if array.dtype.hasobject or array.nbytes != entry.bytes:
            raise ProtocolError(f"{entry.name}: {entry.dtype} {entry.shape} are not {entry.bytes} bytes")
    pieces = [
        piece for entry in entries for piece in _pieces(entry, arrays[entry.name].reshape(-1).view(np.uint8).data)
    ]
    for first in range(0, len(pieces), AT_ONCE):
        now = pieces[first : first + AT_ONCE]
        place = {"id": event.job, "name": name}
        got = yield tuple(Call("scan.fetch", {**place, "offset": at, "length": len(into)}) for at, into in now)
        for (at, into), piece in zip(now, got, strict=True):
            if not isinstance(piece, bytes | memoryview) or len(piece) != len(into):
                raise ProtocolError(f"scan.fetch of {name} at {at} gave not {len(into)} bytes")
            into[:] = piece
    return arrays


def _pieces(entry: ArrayEntry, into: memoryview) -> list[tuple[int, memoryview]]:
    """(offset in the file, where to) of an array's pieces."""
    firsts = range(0, entry.bytes, MAX_FETCH_BYTES)
    return [(entry.offset + first, into[first : first + MAX_FETCH_BYTES]) for first in firsts]
