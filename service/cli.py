"""The command `fringed`: its signals, and then the program (formats.md, Commands).

Exit status 0: done; 1: the work failed, with message and hint on standard error; 2: wrong usage; 129, 130, 143: ended
by SIGHUP (its terminal was closed), SIGINT, SIGTERM. The commands stand in `service.program`, which takes a while to
import: this file is quick, so that an early Ctrl-C finds its handler.
"""

from __future__ import annotations

import os
import signal
import stat
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 130

# Processes are what shares processors out here. OpenBLAS's own threads spin while they wait for one another: beside
# other work a calibration of a second takes fifteen. Children inherit it; NumPy reads it when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# What OpenCV warns of (a PNG that breaks off) comes back to the caller too, and our error names the file.
os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    _open_streams()
    words = list(sys.argv[1:] if arguments is None else arguments)
    # Both belong to the whole program: they hold wherever they stand.
    debug, as_json = "--debug" in words, "--json" in words
    words = [word for word in words if word != "--debug"] or ["--help"]
    if words[0] == "--json" and len(words) > 1:
        words = [*words[1:], "--json"]
    try:
        with _signals():
            with _interrupts_at_once():
                from service.program import run  # noqa: PLC0415
            return run(words, debug=debug, as_json=as_json)
    except KeyboardInterrupt:  # again, while the first one was being answered
        return INTERRUPTED


def _open_streams() -> None:
    """Streams that the caller closed (>&-) lead nowhere: else the next file opened would take one's number."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest number that is free: this one
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), "w" if number else "r"))


@contextmanager
def _signals() -> Iterator[None]:
    """SIGTERM and SIGHUP end the program like Ctrl-C, by an exception: whatever is under way tidies up behind it."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGTERM, _end)
    if before[signal.SIGHUP] is not signal.SIG_IGN:  # nohup
        signal.signal(signal.SIGHUP, _end)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _interrupts_at_once() -> Iterator[None]:
    """Ctrl-C while modules are imported ends the process there and then: an exception would leave some half made."""
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:  # a shell's background job
        signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _end(number: int, _frame: FrameType | None) -> None:
    if number == signal.SIGHUP:
        # The terminal is gone. Writing to it would fail, in the middle of the tidying up. (isatty now says no.)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for descriptor in (1, 2):
            if stat.S_ISCHR(os.fstat(descriptor).st_mode):
                os.dup2(nowhere, descriptor)
        os.close(nowhere)
    raise SystemExit(128 + number)


if __name__ == "__main__":
    sys.exit(main())
