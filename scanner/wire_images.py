"""The messages with pixels, of the preview and live sockets: one part each, a header and what it describes.

A part is the header's length (4 bytes, little-endian), the header in MessagePack, and the values, row by row.
"""

from __future__ import annotations

from typing import Literal, TypeVar

import msgspec
from msgspec import Struct

from scanner.errors import ProtocolError
from scanner.wire import decoded


class PreviewHeader(Struct, frozen=True, kw_only=True):
    """Header of a preview or live message. Numbered, so that dropped ones are counted."""

    number: int
    width: int
    height: int
    dtype: Literal["uint8", "uint16"]
    t_ns: int
    stride: int = 1
    """camera pixels per preview pixel"""


class LiveHeader(Struct, frozen=True, kw_only=True):
    """Header of a live result. Times are CLOCK_MONOTONIC, ns."""

    number: int
    """counts camera frames of this run from 0: a difference above 1 is what was dropped in between"""
    job: str
    content: Literal["rows", "columns", "xyz"]
    width: int
    height: int
    """of the image that follows, px; 0 where there is none (`error`)"""
    dtype: Literal["uint16", "float32"]
    stride: int = 1
    """camera pixels from one value to the next, both ways"""
    scale: float = 0.0
    """rows and columns: value = round((row + 0.5) * scale), 0 = none; xyz: 0"""
    points: int = 0
    """pixels of the camera's image with a value (xyz: with a point, after the filters)"""
    frame_id: int = 0
    """the camera's own count"""
    start_ns: int = 0
    end_ns: int = 0
    """the frame's exposure, first row's start to last row's end"""
    sent_ns: int = 0
    """when this message was given to the socket: minus `end_ns` it is the latency"""
    decode_ms: float = 0.0
    """time of decoding and, for xyz, of triangulation and filters"""
    error: str | None = None
    """why this frame gave nothing"""


_Header = TypeVar("_Header", PreviewHeader, LiveHeader)
_encoder = msgspec.msgpack.Encoder()
_previews = msgspec.msgpack.Decoder(PreviewHeader)
_lives = msgspec.msgpack.Decoder(LiveHeader)
_ITEM_BYTES = {"uint8": 1, "uint16": 2, "float32": 4}


def encode_image(header: PreviewHeader | LiveHeader, values: bytes | memoryview) -> bytes:
    """A header and its values (little-endian) as one part."""
    head = _encoder.encode(header)
    return b"".join((len(head).to_bytes(4, "little"), head, values))


def decode_preview(data: bytes) -> tuple[PreviewHeader, memoryview]:
    """Header and pixels, height x width, of a preview message.

    Raises:
        ProtocolError: it is none, or its length contradicts its header.
    """
    return _decoded(_previews, data, "a preview")


def decode_live(data: bytes) -> tuple[LiveHeader, memoryview]:
    """Header and values of a live result: height x width (x 3 for xyz).

    Raises:
        ProtocolError: it is none, or its length contradicts its header.
    """
    return _decoded(_lives, data, "a live result")


def _decoded(decoder: msgspec.msgpack.Decoder[_Header], data: bytes, what: str) -> tuple[_Header, memoryview]:
    view = memoryview(data)
    length = int.from_bytes(view[:4], "little")
    header = decoded(decoder, view[4 : 4 + length], what)
    values = view[4 + length :]
    each = _ITEM_BYTES[header.dtype] * (3 if isinstance(header, LiveHeader) and header.content == "xyz" else 1)
    if header.width < 0 or header.height < 0 or len(values) != header.width * header.height * each:
        raise ProtocolError(f"{what} of {header.width} x {header.height} with {len(values)} bytes")
    return header, values
