"""The frames of a capture as its witnesses see them: thumbnails, kept as frames come, and what they said so far.

The last two sentinels speak by their levels alone: what all others have to say is asked for while those are exposed
(`listen`), and the verdict behind the last frame takes a millisecond. It is the same whether anybody listened.
"""

from __future__ import annotations

from collections.abc import Container, Iterable

from scanner.devices import Pixels
from scanner.patterns import PatternSequence
from scanner.sequencer.findings import Witnesses
from scanner.sequencer.thumbnail import thumbnail
from scanner.sequencer.witness import Heard, hear, may_be_heard, witness


class Hearing:
    """One capture's, of any number of repetitions. Patterns are indices: repetition x patterns + position."""

    def __init__(self, sequence: PatternSequence, max_value: int) -> None:
        """max_value: the camera's largest grey level."""
        self._sequence = sequence
        self._max_value = max_value
        self._thumbnails: dict[int, dict[int, Pixels]] = {}
        self._heard: dict[int, Heard] = {}

    def take(self, pattern: int, frame: Pixels) -> None:
        """Look at a frame, (H, W); one of the same pattern before it is forgotten. The array is not kept."""
        repetition, position = divmod(pattern, len(self._sequence))
        self._thumbnails.setdefault(repetition, {})[position] = thumbnail(frame)

    def lose(self, pattern: int) -> None:
        """Forget the frame of a pattern, if there was one."""
        repetition, position = divmod(pattern, len(self._sequence))
        self._thumbnails.get(repetition, {}).pop(position, None)

    def has(self, pattern: int) -> bool:
        """Whether the frame of a pattern was taken."""
        repetition, position = divmod(pattern, len(self._sequence))
        return position in self._thumbnails.get(repetition, ())

    def listen(self, pattern: int) -> None:
        """Ask, once for each repetition, as soon as only its last two sentinels are missing; `pattern` is one of it."""
        repetition = pattern // len(self._sequence)
        if repetition in self._heard:
            return
        shown = self._thumbnails.get(repetition, {})
        if may_be_heard(self._sequence, shown):
            self._heard[repetition] = hear(self._sequence, shown, self._max_value)

    def witnesses(self, repetition: int, without: Container[int] = (), among: Iterable[int] | None = None) -> Witnesses:
        """Everything that the frames of one repetition say.

        Args:
            without: patterns that are known to be wrong. among: of these alone; None: of all.
        """
        first, shown = repetition * len(self._sequence), self._thumbnails.get(repetition, {})
        chosen = shown.keys() if among is None else shown.keys() & {pattern - first for pattern in among}
        frames = {position: shown[position] for position in sorted(chosen) if first + position not in without}
        return witness(self._sequence, frames, self._max_value, self._heard.get(repetition))
