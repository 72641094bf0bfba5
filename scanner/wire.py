"""The messages between a client and the daemon, as types and bytes: JSON-RPC 2.0 members in MessagePack.

No socket is opened here; `scanner.session` holds a client's side of the conversation, `scanner.stream` the messages
between daemon and worker, `scanner.wire_images` those with pixels. The specification for other languages is
docs/reference/protocol.md; its bytes are made from these types.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from scanner.errors import ProtocolError, ScannerError, from_data
from scanner.wire_hints import request_hint, values_hint

PROTOCOL = (1, 0)
"""Major and minor version: another major is refused, another minor is not."""

MAX_REQUEST_BYTES = 1 << 14
"""Larger requests are answered with an error. The longest that makes sense is a third of it: 341 frequencies with their
shifts, and a table of 256 grey levels."""

MAX_SENT_BYTES = 2 << 20
"""Larger messages to the daemon are not received at all: ZeroMQ drops the connection (ZMQ_MAXMSGSIZE)."""

MAX_FETCH_BYTES = 4 << 20
"""Most bytes of a file in one answer."""

MAX_MESSAGE_BYTES = 8 << 20
"""No message of the daemon or a worker is larger; nor does the other of the two receive more."""

MAX_LIVE_BYTES = 64 << 20
"""The same for live results: 5 megapixels of XYZ."""

MAX_MESSAGE_TEXT = 4000
"""Characters of an error's message"""

MAX_STRIDE = 64
"""Live XYZ is thinned by this at most."""

TERMINAL_STATES = frozenset({"done", "failed", "cancelled"})
"""States that a job does not leave."""

WELCOME = b"welcome"
"""What the events socket sends to a new subscriber once its subscription counts."""

JSONRPC_CODES = {"malformed": -32700, "invalid_request": -32600, "unknown_method": -32601, "invalid_params": -32602}
"""Faults that JSON-RPC 2.0 numbers itself; every other error has its class's own code."""


class Refused(ProtocolError):
    """A message was understood as far as its fault, and refused. `reason` is a word for programs."""

    def __init__(self, message: str, *, reason: str, hint: str | None = None) -> None:
        super().__init__(message, hint=hint)
        self.reason = reason

    def data(self) -> dict[str, Any]:
        """The error's details, with the reason."""
        return {**super().data(), "class": ProtocolError.__name__, "reason": self.reason}


# --- envelopes ----------------------------------------------------------------------------------------------------


class Request(Struct, frozen=True, kw_only=True):
    """A call. `id` only correlates: it is chosen by the client and comes back with the answer."""

    jsonrpc: Literal["2.0"] = "2.0"
    id: int | str
    method: str
    params: dict[str, Any] = {}


class _Called(Struct, frozen=True, kw_only=True):
    """A call as it came: "jsonrpc" has to be said, and the parameters are not made objects yet."""

    jsonrpc: Literal["2.0"]
    id: int | str
    method: str
    params: msgspec.Raw = msgspec.Raw(b"\x80")


class _Identified(Struct, frozen=True):
    """A call of which nothing but the id is read."""

    id: int | str | None = None


class ErrorBody(Struct, frozen=True):
    """An error: code, message for people, and data {class, device, hint, ...} for programs."""

    code: int
    message: str
    data: dict[str, Any] = {}


class Response(Struct, frozen=True, kw_only=True):
    """The answer to a call: `result` or `error`. `id` is null where the call's own could not be read."""

    jsonrpc: Literal["2.0"] = "2.0"
    id: int | str | None
    result: Any = UNSET
    error: ErrorBody | UnsetType = UNSET


class Event(Struct, frozen=True):
    """Something that happened. Numbered from 1 since the daemon started, without gaps."""

    number: int
    kind: str
    job: str | None = None
    fields: dict[str, Any] = {}


class Notification(Struct, frozen=True, kw_only=True):
    """An event on the events socket, as a JSON-RPC notification."""

    jsonrpc: Literal["2.0"] = "2.0"
    method: Literal["event"] = "event"
    params: Event


# --- parameters ---------------------------------------------------------------------------------------------------


class Hello(Struct, frozen=True, forbid_unknown_fields=True):
    """First call of every connection."""

    protocol: tuple[int, int]
    client: str = ""


class Nothing(Struct, frozen=True, forbid_unknown_fields=True):
    """No parameters."""


class FilterParams(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Which points a cloud leaves out. What is not given keeps the daemon's default."""

    edges: bool | None = None
    max_angle_deg: float | None = None
    min_fragment: int | None = None
    depth: tuple[float, float] | None = None
    box: tuple[float, float, float, float, float, float] | None = None
    min_confidence: float | None = None


class ScanStart(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A scan to make. Everything but `job_id` has a default."""

    job_id: str
    method: str = "pmp"
    pattern: dict[str, Any] | None = None
    exposure: float | Literal["auto"] | None = None
    """microseconds; "auto" measures; None: what the rig file says"""
    decoder: str = "default"
    filters: FilterParams = FilterParams()
    compare_truth: bool = False
    repeat: int = 1


class LiveStart(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A live run to start: one pattern stays on, and every camera frame becomes a result."""

    job_id: str
    method: Literal["mcp"] = "mcp"
    pattern: dict[str, Any] | None = None
    exposure: float | Literal["auto"] | None = None
    """microseconds; "auto" measures; None: what the rig file says"""
    decoder: str = "default"
    content: Literal["rows", "xyz"] = "rows"
    """rows: projector rows (columns where the pattern measures those), uint16; xyz: float32, mm"""
    stride: Annotated[int, Meta(ge=1, le=MAX_STRIDE)] = 1
    """xyz: every so many pixels both ways"""
    filters: FilterParams = FilterParams()
    """xyz: which points are left out"""
    retain: Literal["none", "ring", "record"] = "none"
    """frames kept: none; the last `ring_s` seconds; all"""
    ring_s: Annotated[float, Meta(gt=0, le=3600)] = 10.0
    seconds: Annotated[float, Meta(gt=0, le=31_536_000)] | None = None
    """the run ends by itself after this long; None: when it is stopped"""


class LiveStop(Struct, frozen=True, forbid_unknown_fields=True):
    """End a live run; without an id whichever runs."""

    id: str | None = None


class JobRef(Struct, frozen=True, forbid_unknown_fields=True):
    """One job, by its id."""

    id: str


class Fetch(Struct, frozen=True, forbid_unknown_fields=True):
    """A piece of one of a scan's files, by the name that `scan.result` listed."""

    id: str
    name: str
    offset: int = 0
    length: int = MAX_FETCH_BYTES


class PreviewStart(Struct, frozen=True, forbid_unknown_fields=True):
    """A preview: pictures a second, and the greatest width to send, px."""

    rate_hz: float = 10.0
    max_width: int = 480


class ArrayEntry(Struct, frozen=True):
    """An array in scan.npz: C-contiguous from byte `offset` on."""

    name: str
    dtype: str
    """as NumPy writes it: <f4"""
    shape: tuple[int, ...]
    offset: int
    bytes: int


class FileEntry(Struct, frozen=True):
    """One file of a scan."""

    name: str
    bytes: int
    sha256: str


# --- bytes --------------------------------------------------------------------------------------------------------

_T = TypeVar("_T")
_Params = TypeVar("_Params", bound=Struct)

_encoder = msgspec.msgpack.Encoder()
_requests = msgspec.msgpack.Decoder(_Called)
_maps = msgspec.msgpack.Decoder(dict[str, Any])
_identified = msgspec.msgpack.Decoder(_Identified)
_responses = msgspec.msgpack.Decoder(Response)
_notifications = msgspec.msgpack.Decoder(Notification)


def encode(message: Struct) -> bytes:
    """A message's bytes.

    Raises:
        ProtocolError: it holds something that MessagePack has no form for.
    """
    try:
        return _encoder.encode(message)
    except (TypeError, OverflowError, RecursionError) as error:
        raise ProtocolError(f"a message cannot be encoded: {error}") from error


def encode_request(request: Request) -> bytes:
    """A call's bytes.

    Raises:
        Refused: longer than any daemon takes.
    """
    data = encode(request)
    if len(data) > MAX_REQUEST_BYTES:
        raise Refused(
            f"{request.method}: a request of {len(data)} bytes is longer than the {MAX_REQUEST_BYTES} a daemon takes",
            reason="too_large",
        )
    return data


def too_long(length: int) -> Refused:
    """What is said to a request of so many bytes."""
    said = f"a request of {length} bytes, {MAX_REQUEST_BYTES} are taken"
    return Refused(said, reason="too_large", hint="see hello's limits")


def decode_request(data: bytes, check: Callable[[str], None] | None = None) -> Request:
    """Read a call; `check` is given its method, and where it raises the parameters are not read at all.

    Raises:
        Refused: too long, not MessagePack, or not a JSON-RPC 2.0 request.
    """
    if len(data) > MAX_REQUEST_BYTES:
        raise too_long(len(data))
    try:
        called = _requests.decode(data)
        if check is not None:
            check(called.method)
        return Request(id=called.id, method=called.method, params=_maps.decode(called.params))
    except msgspec.ValidationError as error:
        raise Refused(
            f"not a JSON-RPC 2.0 request: {error}",
            reason="invalid_request",
            hint=request_hint(data),
        ) from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise Refused(f"not MessagePack: {error}", reason="malformed") from error


def request_id(data: bytes) -> int | str | None:
    """The id of a request that is not read whole, if it can be. No other member is made an object."""
    if len(data) > MAX_REQUEST_BYTES:
        return None
    try:
        return _identified.decode(data).id
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None


def decoded(decoder: msgspec.msgpack.Decoder[_T], data: bytes | memoryview, what: str) -> _T:
    """Read a message that is `what`.

    Raises:
        ProtocolError: it is not.
    """
    try:
        return decoder.decode(data)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ProtocolError(f"not {what}: {error}") from error


LARGE_BYTES = 1 << 16
"""Bytes that are not copied where that can be helped"""


def answer_head(number: int | str | None, length: int) -> bytes:
    """What comes before `length` bytes, `LARGE_BYTES` or more, that are the result of an answer, in the answer's bytes.

    Together they are what `encode` makes of the whole, but the bytes need not be copied for it.
    """
    if not LARGE_BYTES <= length < 1 << 32:
        raise ValueError(f"{length} bytes have another head")
    return encode(Response(id=number, result=b""))[:-2] + b"\xc6" + length.to_bytes(4, "big")


def decode_response(data: bytes) -> Response:
    """Read an answer.

    Raises:
        ProtocolError: it is none.
    """
    return decoded(_responses, data, "a JSON-RPC response from the daemon")


def decode_event(data: bytes) -> Event:
    """Read a message of the events socket.

    Raises:
        ProtocolError: it is no event.
    """
    return decoded(_notifications, data, "an event").params


def params_as(kind: type[_Params], request: Request) -> _Params:
    """A call's parameters as their type.

    Raises:
        Refused: one is missing, unknown or of the wrong type, named.
    """
    try:
        return msgspec.convert(request.params, kind)
    except msgspec.ValidationError as error:
        hint = values_hint(kind, str(error))
        raise Refused(f"{request.method}: {error}", reason="invalid_params", hint=hint) from error


def error_body(error: ScannerError) -> ErrorBody:
    """An error as it crosses the wire; one that quotes what it refuses, not all of that."""
    reason = getattr(error, "reason", None)
    return ErrorBody(JSONRPC_CODES.get(str(reason), error.code), _shortened(error.message), error.data())


def _shortened(text: str) -> str:
    return text if len(text) <= MAX_MESSAGE_TEXT else f"{text[: MAX_MESSAGE_TEXT - 4]} ..."


def error_from_body(body: ErrorBody) -> ScannerError:
    """The error that crossed the wire, of its class, with its hint."""
    reason = body.data.get("reason")
    if body.data.get("class") == ProtocolError.__name__ and isinstance(reason, str):
        return Refused(body.message, reason=reason, hint=body.data.get("hint"))
    return from_data(body.message, body.data)
