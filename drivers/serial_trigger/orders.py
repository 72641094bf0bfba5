"""Orders to the board that must be obeyed once and no more, over a line that may destroy the order or its answer."""

from __future__ import annotations

from collections.abc import Callable

from drivers.serial_trigger.link import TRIES, Link, NoAnswerError
from drivers.serial_trigger.protocol import BoardState, board_state
from scanner.errors import DeviceError, DeviceLost


def append(link: Link, index: int, command: str) -> None:
    """Append step `index` to the board's table, exactly once.

    Raises:
        DeviceError: it became another step.
        DeviceLost: it does not come through.
    """
    for _ in range(TRIES):
        try:
            added = link.ask(command, repeat=False)
        except NoAnswerError:
            length = link.ask("SEQ:LEN?")
            if length == str(index):
                continue
            added = str(int(length) - 1) if length.isdigit() else length
        if added != str(index):
            raise DeviceError(
                f"step {index} of the table became step {added}", device=link.name, hint="program it again"
            )
        return
    raise _not_through(link, command)


def once(link: Link, command: str, undone: str, ran: Callable[[], bool]) -> None:
    """Send a command that must not be obeyed twice; where its answer is lost, the board's state tells.

    Args:
        undone: the state that the board is in if it has not obeyed; or if it has, and its run was over at once.
        ran: whether a run has begun since this call.

    Raises:
        DeviceLost: it does not come through.
        RefusedError: the board refuses.
    """
    for _ in range(TRIES):
        try:
            link.ask(command, repeat=False)
        except NoAnswerError:
            if state(link).state == undone and not ran():
                continue
        return
    raise _not_through(link, command)


def state(link: Link) -> BoardState:
    """The board's state."""
    value = link.ask("STAT?")
    found = board_state(value)
    if found is None:
        raise DeviceError(f"STAT? was answered with {value!r}", device=link.name)
    return found


def _not_through(link: Link, command: str) -> DeviceLost:
    return DeviceLost(
        f"{command} never arrives, though other requests do",
        device=link.name,
        hint="press the board's reset button; if that does not help, flash its firmware again",
    )
