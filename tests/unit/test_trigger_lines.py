"""The trigger board's lines: framing, check sums and the reader that finds messages in whatever bytes come."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from drivers.serial_trigger.protocol import (
    BoardState,
    Damaged,
    EventsLost,
    LineReader,
    Message,
    Ok,
    Pulse,
    Ready,
    Refusal,
    RunEnded,
    board_state,
    parse,
    pulse_from,
)
from scanner.trigger_protocol import LINE_MAX, crc8, framed, unframed

SHORT = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=50)

MESSAGES: dict[str, Message] = {
    "OK": Ok(),
    "OK 3": Ok("3"),
    "OK IDLE 3 NONE": Ok("IDLE 3 NONE"),
    "ERR 4,state": Refusal(4, "state"),
    "!EVT 65535 63 4294967295": Pulse(65535, 63, 4294967295),
    "!EVT READY": Ready(),
    "!FAULT NOEDGE 2 0 134667": RunEnded("NOEDGE", 2, 0, 134667),
    "!FAULT OVERRUN 2 0 134667": RunEnded("OVERRUN", 2, 0, 134667),
    "!FAULT LOST 12": EventsLost(12),
}


def test_each_line_is_its_message() -> None:
    for text, message in MESSAGES.items():
        assert LineReader(need_sum=True).feed(framed(text)) == [message]
        assert LineReader().feed(framed(text, sum_=False)) == [message]


def test_what_is_no_line_of_the_protocol_is_damaged() -> None:
    for text in ("", "OKAY", "OK ", "ERR", "ERR x,y", "!EVT 1 2", "!FAULT SMOKE", "$GPGGA,1", "!EVT 1 2 3 4"):
        assert isinstance(parse(text.encode(), need_sum=False), Damaged)


def test_a_line_without_a_sum_is_damaged_where_one_is_needed_but_for_ready() -> None:
    reader = LineReader(need_sum=True)
    assert reader.feed(b"OK 1\n!EVT READY\n!EVT READY*00\n") == [
        Damaged(b"OK 1"),
        Ready(),
        Damaged(b"!EVT READY*00"),
    ]


@given(st.lists(st.sampled_from(sorted(MESSAGES)), max_size=8), st.data())
def test_messages_come_out_however_the_bytes_are_cut(texts: list[str], data: st.DataObject) -> None:
    stream = b"".join(framed(text) for text in texts)
    reader, found = LineReader(need_sum=True), []
    while stream:
        cut = data.draw(st.integers(1, len(stream)))
        found += reader.feed(stream[:cut])
        stream = stream[cut:]
    assert found == [MESSAGES[text] for text in texts]


@given(st.binary(max_size=300), st.sampled_from(sorted(MESSAGES)))
def test_after_any_garbage_the_next_line_is_read(garbage: bytes, text: str) -> None:
    reader = LineReader(need_sum=True)
    reader.feed(garbage + b"\n")
    assert reader.feed(framed(text)) == [MESSAGES[text]]


@given(SHORT, st.integers(0, 7), st.data())
def test_a_flipped_bit_is_found(text: str, bit: int, data: st.DataObject) -> None:
    """CRC-8 finds every single bit error; in the end of the line it makes no line at all, or one without a sum."""
    line = framed(text)[:-1]
    place = data.draw(st.integers(0, len(line) - 1))
    flipped = line[:place] + bytes([line[place] ^ 1 << bit]) + line[place + 1 :]
    assert unframed(flipped)[1] != "right"


@given(SHORT)
def test_framing_is_undone(text: str) -> None:
    assert unframed(framed(text)[:-1]) == (text, "right")
    assert unframed(framed(text, sum_=False)[:-1])[0] == text or "*" in text


def test_the_sum_is_crc_8() -> None:
    assert crc8(b"123456789") == 0xF4
    assert crc8(b"") == 0


def test_a_line_that_is_too_long_is_one_damaged_line() -> None:
    reader = LineReader()
    found = reader.feed(b"A" * 500) + reader.feed(b"A" * 500 + b"\nOK\n")
    assert found == [Damaged(b"A" * LINE_MAX), Ok()]


def test_answers_to_queries_are_understood_or_none() -> None:
    assert board_state("ARMED 12 NOEDGE") == BoardState("ARMED", 12, "NOEDGE")
    assert board_state("12") is None
    assert pulse_from("1 2 3") == Pulse(1, 2, 3)
    assert pulse_from("READY") is None
