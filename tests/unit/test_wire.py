"""The wire: round trips, recorded bytes, and what broken bytes get. No socket."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner import stream, wire, wire_images, wire_vectors
from scanner.endpoints import ipc_path, sibling
from scanner.errors import DeviceLost, ProtocolError, ScannerError, SyncError
from scanner.session import JobWatch, Session
from scanner.wire import Event, Notification, Refused, Request, Response

REFERENCE = Path(__file__).parents[2] / "docs" / "reference"

READERS: tuple[Callable[[bytes], object], ...] = (
    wire.decode_request,
    wire.decode_response,
    wire.decode_event,
    wire_images.decode_preview,
    wire_images.decode_live,
    stream.decode_from_worker,
    stream.decode_to_worker,
)

NESTED = b"\x84\xa7jsonrpc\xa32.0\xa2id\x01\xa6method\xa1x\xa6params\x81\xa1a" + b"\x91" * 16_000

plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False) | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)
maps = st.dictionaries(st.text(), plain, max_size=5)


@given(st.integers(-(2**63), 2**63 - 1) | st.text(), st.text(), maps)
def test_request_round_trip(number: int | str, method: str, params: dict[str, Any]) -> None:
    request = Request(id=number, method=method, params=params)
    assert wire.decode_request(wire.encode(request)) == request


@given(plain)
def test_any_msgpack_library_makes_and_reads_the_same(result: Any) -> None:
    data = wire.encode(Response(id=1, result=result))
    assert msgpack.unpackb(data) == {"jsonrpc": "2.0", "id": 1, "result": result}
    assert wire.decode_response(msgpack.packb({"jsonrpc": "2.0", "id": 1, "result": result})).result == result


@given(st.integers(0, 2**63), st.text(), st.none() | st.text(), maps)
def test_event_round_trip(number: int, kind: str, job: str | None, fields: dict[str, Any]) -> None:
    event = Event(number, kind, job, fields)
    assert wire.decode_event(wire.encode(Notification(params=event))) == event


@given(st.binary(max_size=300))
@settings(max_examples=300)
def test_any_bytes_are_refused_in_words(data: bytes) -> None:
    for read in READERS:
        said = "a message"
        try:
            read(data)
        except ProtocolError as refused:  # nothing else may come out
            said = str(refused)
        assert said


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**40))
def test_preview_round_trip(width: int, height: int, number: int) -> None:
    header = wire_images.PreviewHeader(number=number, width=width, height=height, dtype="uint16", t_ns=1)
    pixels = bytes(2 * width * height)
    found, seen = wire_images.decode_preview(wire_images.encode_image(header, pixels))
    assert (found, bytes(seen)) == (header, pixels)
    with pytest.raises(ProtocolError):
        wire_images.decode_preview(wire_images.encode_image(header, pixels[1:]))


@pytest.mark.parametrize(
    ("data", "reason", "code"),
    [
        (b"", "malformed", -32700),
        (b"\xc1", "malformed", -32700),
        (b"\x83\xa7jsonrpc", "malformed", -32700),
        (msgpack.packb([1, 2]), "invalid_request", -32600),
        (msgpack.packb({"jsonrpc": "2.0", "id": 1}), "invalid_request", -32600),
        (msgpack.packb({"jsonrpc": "1.0", "id": 1, "method": "status"}), "invalid_request", -32600),
        (msgpack.packb({"id": 1, "method": "status"}), "invalid_request", -32600),
        (msgpack.packb({"jsonrpc": "2.0", "id": None, "method": "status"}), "invalid_request", -32600),
        (NESTED, "malformed", -32700),
        (bytes(wire.MAX_REQUEST_BYTES + 1), "too_large", -32011),
    ],
)
def test_broken_requests(data: bytes, reason: str, code: int) -> None:
    with pytest.raises(Refused) as caught:
        wire.decode_request(data)
    assert caught.value.reason == reason
    assert wire.error_body(caught.value).code == code


def test_the_id_of_a_broken_request_is_found_if_it_can_be() -> None:
    assert wire.request_id(msgpack.packb({"id": 5, "method": 7})) == 5
    assert wire.request_id(msgpack.packb({"id": "a"})) == "a"
    assert wire.request_id(msgpack.packb({"id": True})) is None
    assert wire.request_id(b"\xc1") is None
    assert wire.request_id(msgpack.packb({"id": 5, "more": bytes(wire.MAX_REQUEST_BYTES)})) is None


def test_finding_the_id_makes_nothing_of_the_other_members() -> None:
    lists = b"\x82\xa6params\xdd" + (16_000).to_bytes(4, "big") + b"\x90" * 16_000 + b"\xa2id\x07"
    tracemalloc.start()
    assert wire.request_id(lists) == 7
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100_000  # the lists would take a megabyte


def test_members_of_envelopes_that_are_not_known_are_ignored() -> None:
    data = msgpack.packb({"jsonrpc": "2.0", "id": 1, "method": "status", "later": [1]})
    assert wire.decode_request(data).method == "status"


@pytest.mark.parametrize(
    ("kind", "params", "hint"),
    [
        (wire.ScanStart, {"job_id": "x", "exposure": "often"}, 'exposure: a number, "auto" or null'),
        (wire.LiveStart, {"job_id": "x", "method": "pmp"}, 'method: "mcp"'),
        (wire.LiveStart, {"job_id": "x", "retain": "all"}, 'retain: "none", "record" or "ring"'),
        (wire.LiveStart, {"job_id": "x", "stride": "two"}, None),
    ],
)
def test_values_that_a_parameter_takes_are_listed(kind: Any, params: dict[str, Any], hint: str | None) -> None:
    with pytest.raises(Refused) as caught:
        wire.params_as(kind, Request(id=1, method="live.start", params=params))
    assert caught.value.hint == hint


def test_a_request_in_json_text_is_told_so() -> None:
    with pytest.raises(Refused) as caught:
        wire.decode_request(b' {"jsonrpc": "2.0", "id": 1, "method": "status"}')
    assert "this is JSON text" in str(caught.value.hint)
    with pytest.raises(Refused) as caught:
        wire.decode_request(b"\x01")
    assert "JSON text" not in str(caught.value.hint)


@pytest.mark.parametrize(
    ("params", "named"),
    [
        ({"job_id": "x", "exposure": "often"}, "exposure"),
        ({"job_id": "x", "filtres": {}}, "filtres"),
        ({"job_id": "x", "filters": {"depth": [1, 2, 3]}}, "depth"),
        ({"job_id": "x", "repeat": 1.5}, "repeat"),
        ({}, "job_id"),
    ],
)
def test_wrong_parameters_are_named(params: dict[str, Any], named: str) -> None:
    with pytest.raises(Refused, match=named) as caught:
        wire.params_as(wire.ScanStart, Request(id=1, method="scan.start", params=params))
    assert caught.value.reason == "invalid_params"


@pytest.mark.parametrize(
    "error",
    [
        DeviceLost("gone", device="camera 0", hint="plug it in"),
        SyncError("out of step", frames=(3, 4), hint="again"),
        Refused("no", reason="unknown_job", hint="scan.list"),
        ScannerError("plain"),
    ],
)
def test_errors_keep_class_hint_and_details(error: ScannerError) -> None:
    body = wire.decode_response(wire.encode(Response(id=1, error=wire.error_body(error)))).error
    assert isinstance(body, wire.ErrorBody)
    found = wire.error_from_body(body)
    assert type(found) is type(error)
    assert (found.message, found.device, found.hint) == (error.message, error.device, error.hint)
    assert getattr(found, "frames", None) == getattr(error, "frames", None)
    assert getattr(found, "reason", None) == getattr(error, "reason", None)


@pytest.mark.parametrize("length", [wire.LARGE_BYTES, wire.LARGE_BYTES + 1, 4 << 20])
@pytest.mark.parametrize("number", [7, "seven", None])
def test_an_answer_of_many_bytes_is_read_in_place(number: int | str | None, length: int) -> None:
    content = bytes(length)
    data = wire.answer_head(number, length) + content
    assert data == wire.encode(Response(id=number, result=content))
    found, result = Session.answer_in_place(memoryview(data))
    assert (found, result) == (number, content)
    assert isinstance(result, memoryview)
    with pytest.raises(ValueError, match="another head"):
        wire.answer_head(number, wire.LARGE_BYTES - 1)


def test_other_answers_are_read_in_place_as_ever() -> None:
    refused = Response(id=1, error=wire.error_body(Refused("no", reason="unknown_file")))
    for response in (Response(id=1, result={"a": [1, 2]}), Response(id=1), Response(id=1, result=b"few"), refused):
        data = wire.encode(response)
        (a, b), (c, d) = Session.answer(data), Session.answer_in_place(memoryview(data))
        assert a == c
        assert repr(b) == repr(d) or b == d
    with pytest.raises(ProtocolError):
        Session.answer_in_place(memoryview(b"\xc1"))


@pytest.mark.parametrize(
    "endpoint", ["tcp://127.0.0.1:5555", "ipc://relative", "ipc:///" + 120 * "x", "inproc://a", "ipc:///a\0b"]
)
def test_endpoints_that_are_not_served(endpoint: str) -> None:
    with pytest.raises(Refused):
        ipc_path(endpoint)


def test_sibling_endpoints() -> None:
    assert sibling("ipc:///run/fringed/control.ipc", "events") == "ipc:///run/fringed/events.ipc"
    assert sibling("ipc:///tmp/a.ipc", "events") == "ipc:///tmp/a-events.ipc"


# --- recorded bytes -----------------------------------------------------------------------------------------------


def test_recorded_vectors_are_current() -> None:
    assert (REFERENCE / "protocol-vectors.json").read_text(encoding="utf-8") == wire_vectors.as_json()
    page = (REFERENCE / "protocol.md").read_text(encoding="utf-8")
    assert page == wire_vectors.with_examples(page), "python -m scanner.wire_vectors docs/reference"


def test_recorded_bytes_mean_what_they_say() -> None:
    content = json.loads((REFERENCE / "protocol-vectors.json").read_text(encoding="utf-8"))
    for vector in content["vectors"]:
        if vector["name"] == "preview":
            header, pixels = wire_images.decode_preview(bytes.fromhex(vector["hex"]))
            assert (header.width * header.height, pixels.hex()) == (4, vector["message"]["pixels"]["bytes"])
            continue
        if vector["name"] == "live":
            live, values = wire_images.decode_live(bytes.fromhex(vector["hex"]))
            assert (live.width * live.height, values.hex()) == (4, vector["message"]["values"]["bytes"])
            continue
        found = msgpack.unpackb(bytes.fromhex(vector["hex"]))
        assert wire_vectors._shown(found) == vector["message"], vector["name"]


def test_every_method_and_message_is_recorded() -> None:
    names = {vector["name"] for vector in wire_vectors.vectors()}
    tags = {kind.__struct_config__.tag for union in (stream.FromWorker, stream.ToWorker) for kind in union.__args__}
    assert {f"worker: {tag}" for tag in tags} <= names


def test_every_method_stands_in_the_specification() -> None:
    page = (REFERENCE / "protocol.md").read_text(encoding="utf-8")
    for method, _, _ in wire_vectors.CALLS:
        assert f"`{method}`" in page


# --- the client's side --------------------------------------------------------------------------------------------


def test_session_refuses_another_major_version() -> None:
    with pytest.raises(Refused, match="protocol"):
        Session.check_welcome({"protocol": [2, 0]})
    assert Session.check_welcome({"protocol": [1, 9], "endpoints": {"events": "e"}}) == {"events": "e"}


def test_session_refuses_what_is_too_long() -> None:
    session = Session()
    with pytest.raises(Refused, match="longer"):
        session.request(wire_call({"text": "x" * wire.MAX_REQUEST_BYTES}))


def wire_call(params: dict[str, Any]) -> Any:
    from scanner.session import Call  # noqa: PLC0415

    return Call("status", params)


def watch_of(job: str) -> JobWatch:
    watch = JobWatch(job)
    watch.state({"number": 10, "state": "queued", "id": job})
    return watch


def test_watch_passes_its_jobs_events_and_ends() -> None:
    watch = watch_of("a")
    assert watch.event(Event(9, "queued", "a")) == []
    assert watch.event(Event(11, "started", "a")) == [Event(11, "started", "a")]
    assert watch.event(Event(12, "frame", "b")) == []
    assert not watch.needs_state
    assert watch.event(Event(13, "done", "a"))
    assert watch.finished


def test_watch_asks_after_a_gap_and_stands_in_for_what_was_lost() -> None:
    watch = watch_of("a")
    watch.event(Event(14, "frame", "b"))
    assert watch.needs_state
    (event,) = watch.state({"number": 20, "state": "done", "id": "a"})
    assert (event.kind, event.fields["snapshot"]) == ("done", True)
    assert watch.finished


def test_watch_asks_after_silence_and_says_nothing_twice() -> None:
    watch = watch_of("a")
    assert watch.event(None) == []
    assert watch.needs_state
    assert watch.state({"number": 10, "state": "queued", "id": "a"}) == []


def test_watch_survives_a_daemon_that_numbers_anew() -> None:
    watch = watch_of("a")
    watch.event(Event(11, "acquired", "a"))
    watch.event(Event(1, "acquired", "a"))
    assert watch.needs_state
    watch.state({"number": 2, "state": "acquired", "id": "a"})
    assert watch.event(Event(3, "done", "a"))
