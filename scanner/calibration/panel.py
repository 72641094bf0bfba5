"""One panel of a drawn report: a title, two axes with ticks and units, and what takes values to its pixels.

Drawn with OpenCV, which every installation has. What is drawn into a panel is `pictures`'s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Canvas = NDArray[np.uint8]
Colour = tuple[int, int, int]
"""blue, green, red"""

SIZE = (640, 500)
LEFT, RIGHT, TOP, BOTTOM = 62, 22, 58, 74
INK, DIM, FAINT = (40, 40, 40), (110, 110, 110), (215, 215, 215)
TICK_PX = 5


@dataclass(frozen=True, eq=False)
class Axis:
    """Values from one end to the other (which may be the smaller one), and what they are, with the unit."""

    first: float
    last: float
    label: str
    ticks: bool = True


@dataclass(frozen=True, eq=False)
class Panel:
    """canvas: (H, W, 3) uint8; x runs to the right, y downwards. area: left, top, right, bottom px of the field."""

    canvas: Canvas
    x: Axis
    y: Axis
    area: tuple[float, float, float, float]

    def place(self, points: Array) -> Array:
        """(N, 2) px of the canvas for (N, 2) values of the axes."""
        left, top, right, bottom = self.area
        across = left + (points[:, 0] - self.x.first) / (self.x.last - self.x.first) * (right - left)
        down = top + (points[:, 1] - self.y.first) / (self.y.last - self.y.first) * (bottom - top)
        return np.column_stack((across, down))

    def text(self, words: str, at: tuple[float, float], colour: Colour = INK, size: float = 0.42) -> None:
        """Words whose lower left corner is at a px of the canvas."""
        cv2.putText(self.canvas, words, _at(at), cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)

    def line(self, points: Array, colour: Colour, width: int = 1) -> None:
        """A line through (N, 2) px of the canvas."""
        cv2.polylines(self.canvas, [np.rint(points).astype(np.int32)], False, colour, width, cv2.LINE_AA)

    def dot(self, at: Array, radius: int, colour: Colour) -> None:
        """A disc about a px of the canvas."""
        cv2.circle(self.canvas, _at(at), radius, colour, -1, cv2.LINE_AA)

    def bar(self, corner: Array, opposite: Array, colour: Colour) -> None:
        """A filled rectangle between two px of the canvas."""
        cv2.rectangle(self.canvas, _at(corner), _at(opposite), colour, -1)

    def note(self, words: str) -> None:
        """A line of words below the axes."""
        self.text(words, (LEFT, SIZE[1] - 14), DIM)

    def legend(self, entries: Sequence[tuple[str, Colour]]) -> None:
        """What the colours mean, in the upper right corner of the field."""
        for k, (words, colour) in enumerate(entries):
            y = self.area[1] + 18 + 18 * k
            width = text_width(words)
            x = self.area[2] - 10 - width
            self.line(np.array([[x - 26, y - 4], [x - 8, y - 4]]), colour, 3)
            self.text(words, (x, y))


def panel(title: str, x: Axis, y: Axis, *, square: bool = False) -> Panel:
    """An empty panel with its title and axes; square: a unit is as long on both."""
    canvas = np.full((SIZE[1], SIZE[0], 3), 255, dtype=np.uint8)
    left, top, right, bottom = float(LEFT), float(TOP), float(SIZE[0] - RIGHT), float(SIZE[1] - BOTTOM)
    if square:
        scale = min((right - left) / abs(x.last - x.first), (bottom - top) / abs(y.last - y.first))
        right, bottom = left + scale * abs(x.last - x.first), top + scale * abs(y.last - y.first)
    drawn = Panel(canvas, x, y, (left, top, right, bottom))
    drawn.text(title, (LEFT, 24), INK, 0.55)
    cv2.rectangle(canvas, _at((left, top)), _at((right, bottom)), FAINT, 1, cv2.LINE_AA)
    _ticks_of_x(drawn)
    _ticks_of_y(drawn)
    return drawn


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """At most so many round values within the bounds: multiples of 1, 2 or 5 times a power of ten."""
    low, high = min(low, high), max(low, high)
    rough = max((high - low) / max(most - 1, 1), 1e-12)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(f * power for f in (1, 2, 5, 10) if f * power >= rough * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def text_width(words: str, size: float = 0.42) -> int:
    """Of words, in px of the canvas."""
    (width, _), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    return int(width)


def _ticks_of_x(drawn: Panel) -> None:
    _, _, right, bottom = drawn.area
    if drawn.x.ticks:
        values = ticks(drawn.x.first, drawn.x.last)
        for value in values:
            (at,) = drawn.place(np.array([[value, drawn.y.first]]))
            drawn.line(np.array([[at[0], bottom], [at[0], bottom + TICK_PX]]), DIM)
            words = _number(value, values)
            drawn.text(words, (at[0] - text_width(words) / 2, bottom + 20), DIM)
    drawn.text(drawn.x.label, (right - text_width(drawn.x.label), bottom + 38), DIM)


def _ticks_of_y(drawn: Panel) -> None:
    left, top, _, _ = drawn.area
    if drawn.y.ticks:
        values = ticks(drawn.y.first, drawn.y.last)
        for value in values:
            (at,) = drawn.place(np.array([[drawn.x.first, value]]))
            drawn.line(np.array([[left - TICK_PX, at[1]], [left, at[1]]]), DIM)
            words = _number(value, values)
            drawn.text(words, (left - TICK_PX - 4 - text_width(words), at[1] + 4), DIM)
    drawn.text(drawn.y.label, (left, top - 8), DIM)


def _number(value: float, values: Sequence[float]) -> str:
    """As few digits as tell the ticks apart."""
    step = min((abs(b - a) for a, b in pairwise(values)), default=1.0)
    return f"{value + 0.0:.{max(0, -math.floor(math.log10(step) + 1e-9))}f}"


def _at(point: Array | tuple[float, float]) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))
