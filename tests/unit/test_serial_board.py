"""The simulated board does what the golden files say, as the firmware does."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.simulated.serial_board import PinEdge, SerialBoard
from drivers.simulated.serial_board_pty import PtyBoard
from tests.trigger_golden import Golden, Transcript, actions, differences, golden_files


def played(file: Golden) -> Transcript:
    board, transcript = SerialBoard(), Transcript()
    outputs = []
    for t_us, what, value in actions(file):
        t_ns = round(1000 * t_us)
        if what == "bytes":
            board.receive(value, t_ns)
        else:
            board.edge(what, bool(value), t_ns)
        outputs += board.advance(t_ns)
    outputs += board.advance(1000 * file.end_us)
    for output in outputs:
        if isinstance(output, PinEdge):
            transcript.pins.append((output.t_ns / 1e3, output.pin, output.level))
        else:
            transcript.lines.append((output.t_ns / 1e3, output.data.decode().removesuffix("\n")))
    return transcript


@pytest.mark.parametrize("file", golden_files(), ids=lambda file: file.name)
def test_the_simulated_board_keeps_the_golden_files(file: Golden) -> None:
    assert differences(file, played(file)) == []


@pytest.mark.parametrize("file", [file for file in golden_files() if file.pins], ids=lambda file: file.name)
def test_a_golden_file_notices_what_is_wrong(file: Golden) -> None:
    """The comparison itself: a pin that is late, missing or unasked, and a line that is, are found."""
    transcript = played(file)
    t, pin, level = transcript.pins[-1]
    for pins in (
        [*transcript.pins[:-1], (t + 1100, pin, level)],
        [*transcript.pins[:-1], (t, pin, 1 - level)],
        transcript.pins[:-1],
        [*transcript.pins, (t + 10, pin, 1)],
    ):
        assert differences(file, Transcript(transcript.lines, pins)) != []
    assert differences(file, Transcript(transcript.lines[:-1], transcript.pins)) != []
    assert differences(file, Transcript([*transcript.lines, (t, "!EVT 0 0 1")], transcript.pins)) != []


@given(st.lists(st.binary(max_size=80), max_size=8))
def test_whatever_is_sent_every_line_has_one_answer_and_no_pin_moves(pieces: list[bytes]) -> None:
    board = SerialBoard()
    board.advance(0)
    for number, piece in enumerate(pieces):
        board.receive(b"\x18\n", number * 10**6)
        assert board.advance(number * 10**6) == []
        line = piece.replace(b"\n", b"").replace(b"\x18", b"")
        board.receive(line + b"\n", number * 10**6)
        said = board.advance(number * 10**6)
        assert all(not isinstance(output, PinEdge) for output in said)
        assert len(said) == (0 if line in (b"", b"\r") else 1)


def test_a_thread_that_comes_late_loses_no_edge() -> None:
    """Nor does it see those that came while the board was deaf."""
    with PtyBoard(vsync_us=1_000, clock_ppm=300.0) as board, board._lock:
        last = board._next_vsync_ns
        period = round(1_000_000 * (1 + 300e-6))
        assert board._edges_until(last - 1) == []
        assert board._edges_until(last + 25 * period) == [last + n * period for n in range(26)]
        assert board._edges_until(last + 25 * period) == []
        board.stop_vsync()
        assert board._edges_until(last + 99 * period) == []
