"""Points of a scan whose files are still being written: what a client asks for when the daemon says `points`."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from scanner.errors import ProtocolError
from scanner.session import Call, Procedure
from scanner.wire import MAX_FETCH_BYTES, ArrayEntry, Event


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
        into = array.reshape(-1).view(np.uint8).data
        for first in range(0, entry.bytes, MAX_FETCH_BYTES):
            length = min(MAX_FETCH_BYTES, entry.bytes - first)
            place = {"id": event.job, "name": name, "offset": entry.offset + first, "length": length}
            piece = yield Call("scan.fetch", place)
            if not isinstance(piece, bytes) or len(piece) != length:
                raise ProtocolError(f"scan.fetch of {entry.name} at {first} gave not {length} bytes")
            into[first : first + length] = piece
    return arrays
