"""The conversation with the board: one request, one answer, repeated where noise or silence took either.

A thread reads, so that nothing is lost in the kernel's buffer while nobody asks and each line has the time it came;
it ends with the port. Requests come from one thread. Silence is not endless: a board that does not answer is lost.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass

from drivers.serial_trigger.protocol import Answer, Damaged, LineReader, Message, Ok, Ready, Refusal
from drivers.serial_trigger.transport import Transport
from scanner.clock import Clock
from scanner.errors import DeviceError, DeviceLost
from scanner.trigger_protocol import ABORT_BYTE, framed

ANSWER_S = 0.15
"""An answer comes within 50 ms of its request; USB and a busy host may add to that"""

TRIES = 6
"""Of a request that noise destroys"""

SILENCES = 3
"""Answers that may stay out before the board counts as lost: 0.45 s, within the second that is promised"""

QUIET_S = 0.03
"""After a damaged line, nothing may come for so long before the next request: what noise made of one line can be two"""

QUIET_MOST_S = 0.3
"""A line that never falls silent is not waited for: another device talks there, and no request is answered"""

_NOISE = {1, 6}
"""Refusals that say the request did not arrive whole: crc, line"""

_NOISE_WITHOUT_SUMS = _NOISE | {2, 7}
"""As long as the board does not insist on check sums, one that was hit itself makes the line another one"""


@dataclass(frozen=True)
class Timed:
    """An answer, with when the request went out and the answer was there, and their lengths on the wire, bytes."""

    value: str
    sent_ns: int
    heard_ns: int
    sent_bytes: int
    heard_bytes: int


class RefusedError(DeviceError):
    """The board does not do it; `refusal` is its number, of `scanner.trigger_protocol.ERRORS`."""

    def __init__(self, message: str, refusal: int, *, device: str | None = None, hint: str | None = None) -> None:
        super().__init__(message, device=device, hint=hint)
        self.refusal = refusal


class NoAnswerError(DeviceError):
    """Whether a request that must not be repeated was obeyed is not known."""


class Link:
    """A transport with a conversation on it."""

    def __init__(self, transport: Transport, clock: Clock, on_message: Callable[[Message], None]) -> None:
        """Begin to read. on_message is called on the reader's thread, for every whole line in its order."""
        self._transport = transport
        self._clock = clock
        self._on_message = on_message
        self._reader = LineReader()
        self._answers: queue.SimpleQueue[tuple[int, Answer | Damaged | DeviceLost]] = queue.SimpleQueue()
        self._closing = threading.Event()
        self.lost: DeviceLost | None = None
        self.damaged = 0
        """lines that noise destroyed"""
        self.heard_ns = clock.now_ns()
        """when the board last said anything whole"""
        self._thread = threading.Thread(target=self._read, name=f"trigger board {transport.name}", daemon=True)
        self._thread.start()

    @property
    def name(self) -> str:
        """The port's name in messages."""
        return self._transport.name

    def require_sums(self) -> None:
        """From now on a line without a check sum is noise."""
        self._reader.need_sum = True

    def ask(self, command: str, *, repeat: bool = True, tries: int = TRIES) -> str:
        """The value that the board answers to `command`.

        Args:
            command: without check sum.
            repeat: whether it may be sent again when no answer came, though it may have been obeyed.
            tries: how often it is sent at most.

        Raises:
            DeviceLost: the port went away, or the board is silent.
            NoAnswerError: not `repeat`, and no answer came.
            RefusedError: the board refuses.
        """
        return self.ask_timed(command, repeat=repeat, tries=tries).value

    def ask_timed(self, command: str, *, repeat: bool = True, tries: int = TRIES) -> Timed:
        """As `ask`, with the times of request and answer."""
        silences = 0
        for _ in range(tries):
            self._clear_answers()
            request = framed(command)
            sent = self._clock.now_ns()
            self._write(request)
            heard = self._next_answer(ANSWER_S)
            if heard is None:
                silences += 1
            elif isinstance(heard[1], Ok):
                if silences:
                    self._wait_for_quiet()  # the answer that stayed out may only have been late
                return Timed(heard[1].value, sent, heard[0], len(request), len(framed(_said(heard[1]))))
            elif isinstance(heard[1], Refusal) and not self._is_noise(heard[1]):
                raise RefusedError(
                    f"the board refuses {command}: {heard[1].text} ({heard[1].code})",
                    heard[1].code,
                    device=self.name,
                    hint="see docs/reference/trigger-protocol.md",
                )
            else:
                self._wait_for_quiet()
                if isinstance(heard[1], Refusal):
                    continue  # it was not obeyed: sending it again is right in any case
            if not repeat:
                raise NoAnswerError(f"no answer to {command} came through", device=self.name)
            if silences >= SILENCES:
                raise self._silent(command)
        raise DeviceLost(
            f"{command} does not come through: {tries} times noise",
            device=self.name,
            hint="check the cable and its ground; keep it away from the projector's supply",
        )

    def knock(self) -> None:
        """Stop whatever runs and end a line that may have been begun; no answer comes."""
        self._write(ABORT_BYTE + b"\n")

    def close(self) -> None:
        """End the reader and give the port back."""
        self._closing.set()
        self._thread.join()
        self._transport.close()

    # --- the reader's thread -------------------------------------------------------------------------------------

    def _read(self) -> None:
        while not self._closing.is_set():
            try:
                received = self._transport.read()
            except DeviceLost as lost:
                self._give_up(lost)
                return
            now = self._clock.now_ns()
            for message in self._reader.feed(received):
                if isinstance(message, Damaged):
                    self.damaged += 1
                    self._answers.put((now, message))
                    continue
                self.heard_ns = now
                if isinstance(message, Ready):
                    self._reader.need_sum = False  # it has begun anew, and gives none until it is told to
                self._on_message(message)
                if isinstance(message, Ok | Refusal):
                    self._answers.put((now, message))

    def _give_up(self, lost: DeviceLost) -> None:
        self.lost = lost
        # At once: while the old port is held, the kernel gives the board another number when it comes back.
        self._transport.close()
        self._answers.put((self._clock.now_ns(), lost))

    # --- the asking thread ---------------------------------------------------------------------------------------

    def _is_noise(self, refusal: Refusal) -> bool:
        return refusal.code in (_NOISE if self._reader.need_sum else _NOISE_WITHOUT_SUMS)

    def _write(self, data: bytes) -> None:
        if self.lost is not None:
            raise self.lost
        try:
            self._transport.write(data)
        except DeviceLost as lost:
            self.lost = lost
            raise

    def _next_answer(self, timeout_s: float) -> tuple[int, Answer | Damaged] | None:
        """The next answer; a damaged line may have been one, unless an answer still follows."""
        deadline = self._clock.now_ns() + round(1e9 * timeout_s)
        damaged: tuple[int, Damaged] | None = None
        while (left := deadline - self._clock.now_ns()) > 0:
            try:
                t_ns, heard = self._answers.get(timeout=left / 1e9)
            except queue.Empty:
                break
            if isinstance(heard, DeviceLost):
                raise heard
            if not isinstance(heard, Damaged):
                return t_ns, heard
            damaged = (t_ns, heard)
            deadline = min(deadline, self._clock.now_ns() + round(2e9 * QUIET_S))
        return damaged

    def _wait_for_quiet(self) -> None:
        until = self._clock.now_ns() + round(1e9 * QUIET_MOST_S)
        while self._next_answer(QUIET_S) is not None and self._clock.now_ns() < until:
            pass

    def _clear_answers(self) -> None:
        """Drop what came too late for the request before."""
        while True:
            try:
                _, heard = self._answers.get_nowait()
            except queue.Empty:
                return
            if isinstance(heard, DeviceLost):
                raise heard

    def _silent(self, command: str) -> DeviceLost:
        self.lost = DeviceLost(
            f"the board does not answer ({command}, {SILENCES} times)",
            device=self.name,
            hint="press its reset button, or unplug it and plug it in again",
        )
        return self.lost


def _said(answer: Ok) -> str:
    return f"OK {answer.value}" if answer.value else "OK"
