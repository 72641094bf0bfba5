"""The decode worker: `python -m service.worker --connect ENDPOINT`. Takes a series frame by frame and makes a scan.

The main thread talks: it takes messages, gives credit back, and says `alive` whatever is being computed. A second
thread decodes (`service.decoding`). Nothing is kept: a worker may be killed at any moment, and its series is sent to
another one.
"""

from __future__ import annotations

import argparse
import logging
import os
import queue
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import msgspec
import zmq

from scanner.client import Client
from scanner.errors import ProtocolError, ScannerError
from scanner.stream import (
    CREDIT,
    HEARTBEAT_S,
    Ack,
    Alive,
    Cancel,
    End,
    Frame,
    FromWorker,
    Identify,
    Leaving,
    LiveBegin,
    LiveFrame,
    Ready,
    Start,
    Stop,
    decode_to_worker,
)
from scanner.wire import MAX_MESSAGE_BYTES, PROTOCOL
from service.descriptors import raise_limit
from service.kept_memory import keep_memory
from service.logs import start_logging
from service.work import Work

CONNECT_MS = 1000
"""How long to wait for the connection before the first word; a word said before it is established is lost."""

_log = logging.getLogger(__name__)
_encoder = msgspec.msgpack.Encoder()

Job = Start | Frame | End | LiveBegin | LiveFrame | Cancel


class Worker:
    """The talking side: one DEALER socket, one lifeline, one working thread."""

    def __init__(self, endpoint: str, *, decode: bool = True, lifeline: int | None = None) -> None:
        """Connect.

        Args:
            endpoint: the daemon's worker endpoint, ipc.
            decode: False checks digests and decodes nothing.
            lifeline: a descriptor; when it closes, the daemon that started this worker is gone.
        """
        self._decode = decode
        self._lifeline = lifeline
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        for option, value in (
            (zmq.LINGER, 0),
            (zmq.SNDHWM, 0),
            (zmq.RCVHWM, 4 * CREDIT),
            (zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES),
            (zmq.RECONNECT_IVL, 50),
            (zmq.RECONNECT_IVL_MAX, 1000),
            (zmq.IMMEDIATE, 1),  # nothing waits for a daemon that is gone: the next one asks who this is
        ):
            self._socket.setsockopt(option, value)
        self._socket.connect(endpoint)
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[FromWorker] = queue.SimpleQueue()
        self._woken, self._wake = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._delivery: int | None = None
        self._said = 0.0
        self._work = Work(self._answer, decode=decode)

    def run(self, ready: Callable[[], None] | None = None) -> None:
        """Serve until told to stop or until the lifeline closes; `ready` is called once the daemon can know of it."""
        thread = threading.Thread(target=self._work.serve, args=(self._jobs,), name="decoder", daemon=True)
        thread.start()
        try:
            self._socket.poll(CONNECT_MS, zmq.POLLOUT)
            self._ready()
            if ready is not None:
                ready()
            self._talk(thread)
        finally:
            self._work.cancel(None)
            self._jobs.put(None)
            with suppress(zmq.Again):
                self._socket.send(_encoder.encode(Leaving()), zmq.DONTWAIT)
            self._context.destroy(linger=100)
            thread.join(timeout=1.0)
            os.close(self._woken)
            os.close(self._wake)

    def _talk(self, decoder: threading.Thread) -> None:
        """Until told to stop; ScannerError if the decoder's thread ends before: its series must go elsewhere."""
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._woken, zmq.POLLIN)
        if self._lifeline is not None:
            poller.register(self._lifeline, zmq.POLLIN)
        while True:
            events = dict(poller.poll(round(HEARTBEAT_S * 500)))
            if not decoder.is_alive():
                raise ScannerError("the decoding thread died", hint="its error stands above, in this log")
            if self._lifeline is not None and self._lifeline in events and not os.read(self._lifeline, 1):
                return
            if self._woken in events:
                with suppress(BlockingIOError):
                    os.read(self._woken, 4096)
            self._forward_answers()
            if self._socket in events and not self._take():
                return
            if time.monotonic() - self._said >= HEARTBEAT_S:
                self._say(Alive())

    def _take(self) -> bool:
        """Everything that has come; False on `stop`."""
        while True:
            try:
                message = decode_to_worker(self._socket.recv(zmq.DONTWAIT))
            except zmq.Again:
                return True
            except ProtocolError as error:
                _log.error("%s", error)
                continue
            match message:
                case Stop():
                    return False
                case Identify():
                    self._ready()
                case Cancel(delivery=delivery):
                    self._work.cancel(delivery)
                    self._jobs.put(message)
                case Start() | Frame() | End() | LiveBegin() | LiveFrame():
                    if isinstance(message, Start | LiveBegin):
                        self._delivery = message.delivery
                    elif isinstance(message, End):
                        self._work.heard(message)
                    self._jobs.put(message)

    def _forward_answers(self) -> None:
        newest: Ack | None = None
        while True:
            try:
                answer = self._answers.get_nowait()
            except queue.Empty:
                break
            if isinstance(answer, Ack):
                newest = answer  # counts are sums: the newest says it all
                continue
            if newest is not None:
                self._say(newest)
                newest = None
            if self._work.idle:
                self._delivery = None
            self._say(answer)
        if newest is not None:
            self._say(newest)

    def _answer(self, message: FromWorker) -> None:
        """Called in the working thread."""
        self._answers.put(message)
        with suppress(BlockingIOError):  # full: the talking thread is awake anyway
            os.write(self._wake, b"\0")

    def _ready(self) -> None:
        self._say(
            Ready(
                protocol=PROTOCOL,
                worker=f"{socket.gethostname()}-{os.getpid()}",
                pid=os.getpid(),
                host=socket.gethostname(),
                decode=self._decode,
                busy=self._delivery,
            )
        )

    def _say(self, message: FromWorker) -> None:
        # No high-water mark on this side: messages are small, and there are at most `credit` of them a turn.
        with suppress(zmq.Again):  # not connected: what is said of a series is void by the time there is a daemon
            self._socket.send(_encoder.encode(message), zmq.DONTWAIT)
        self._said = time.monotonic()


def run_worker(endpoint: str, *, decode: bool = True, ready: Callable[[], None] | None = None) -> None:
    """Serve the daemon at `endpoint` (its control endpoint) until it says stop.

    Args:
        endpoint: as for a client.
        decode: False checks digests and decodes nothing.
        ready: called once it takes work.

    Raises:
        Unreachable: no daemon there.
    """
    raise_limit()  # it publishes live results; the daemon's own workers have its limit
    with Client(endpoint, name="worker") as client:
        address = client.hello()["endpoints"]["worker"]
    Worker(address, decode=decode).run(ready)


def main() -> int:
    """The process that a daemon starts."""
    parser = argparse.ArgumentParser(prog="python -m service.worker", description=run_worker.__doc__)
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--connect", metavar="ENDPOINT", help="the daemon's control endpoint")
    where.add_argument("--serve", metavar="ENDPOINT", help="its worker endpoint, and end when standard input closes")
    parser.add_argument("--discard", action="store_true", help="check digests, decode nothing")
    given = parser.parse_args()
    start_logging("worker")
    keep_memory()
    try:
        if given.serve:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            Worker(given.serve, decode=not given.discard, lifeline=sys.stdin.fileno()).run()
        else:
            run_worker(given.connect, decode=not given.discard)
    except ScannerError as error:
        _log.error("%s (%s)", error, error.hint)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    status = main()
    logging.shutdown()
    # Everything is closed; taking LLVM and SciPy down in order would cost another third of a second.
    os._exit(status)
