"""Colours, colour bars and lettering of the pictures that scans are shown in. All pictures are (h, w, 3) uint8 BGR.

Letters are OpenCV 5's built-in TrueType face, so that no font file has to be found on the machine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]

BACKGROUND: Colour = (20, 16, 13)
PANEL: Colour = (33, 27, 23)
LINE: Colour = (66, 56, 49)
TEXT: Colour = (238, 234, 230)
DIM: Colour = (168, 158, 150)
ACCENT: Colour = (120, 196, 255)

ColourMap = Literal["viridis", "grey", "trust", "diverging"]


@dataclass(frozen=True)
class Scale:
    """How values become colours: limits, colour map, unit."""

    low: float
    high: float
    colours: ColourMap
    unit: str = ""
    reverse: bool = False

    def apply(self, values: NDArray[Any], missing: Colour = PANEL) -> Picture:
        """Values (h, w) to a picture; NaN becomes `missing`."""
        span = self.high - self.low or 1.0
        share = (np.asarray(values, dtype=np.float32) - np.float32(self.low)) * np.float32(255.0 / span)
        index = np.clip(np.nan_to_num(share, nan=0.0), 0, 255).astype(np.uint8)
        picture: Picture = self.table()[index]
        picture[np.isnan(share)] = missing
        return picture

    def table(self) -> Picture:
        """(256, 3) BGR, for low to high."""
        table = _table(self.colours)
        return table[::-1].copy() if self.reverse else table


def scale_of(values: NDArray[Any], colours: ColourMap, unit: str = "", *, reverse: bool = False) -> Scale:
    """A scale from the 0.5th to the 99.5th percentile of the values that are there."""
    there = values[np.isfinite(values)]
    low, high = np.percentile(there, (0.5, 99.5)) if there.size else (0.0, 1.0)
    if high - low < 1e-6 * max(abs(float(high)), 1.0):
        low, high = low - 0.5, high + 0.5
    return Scale(float(low), float(high), colours, unit, reverse)


def fit(values: NDArray[Any], width: int, height: int) -> NDArray[np.float32]:
    """A map reduced to fit into width x height, proportions kept; a pixel is missing where most of its area is.

    Where the map has values on lines only (the peaks of stripes), it is missing where the lines are.
    Small maps are enlarged pixel by pixel, by a whole factor if that fits.
    """
    factor = min(width / values.shape[1], height / values.shape[0])
    if factor > 2:
        factor = math.floor(factor)
    size = (max(1, round(values.shape[1] * factor)), max(1, round(values.shape[0] * factor)))
    there = np.isfinite(values)
    if factor >= 1:
        enlarged = cv2.resize(np.asarray(values, dtype=np.float32), size, interpolation=cv2.INTER_NEAREST)
        return np.asarray(enlarged, dtype=np.float32)
    filled = np.where(there, values, 0).astype(np.float32)
    total = cv2.resize(filled, size, interpolation=cv2.INTER_AREA)
    weight = cv2.resize(there.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    usual = float(np.median(weight[weight > 0])) if there.any() else 1.0
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(weight > 0.5 * usual, total / weight, np.nan).astype(np.float32)


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Round numbers (1, 2 or 5 times a power of ten apart) from low to high, at most `most`."""
    span = high - low
    if not span > 0 or not math.isfinite(span):
        return [low]
    power = 10.0 ** math.floor(math.log10(span / most))
    step = next(m * power for m in (1, 2, 5, 10, 20) if span / (m * power) <= most - 1)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(i * step, 10) for i in range(first, last + 1)]


def text(
    picture: Picture,
    words: str,
    at: tuple[int, int],
    *,
    size: int = 17,
    colour: Colour = TEXT,
    weight: int = 400,
    align: Literal["left", "right", "centre"] = "left",
) -> int:
    """Write words with their baseline at (x, y), in place; returns the width, px."""
    width = text_width(words, size=size, weight=weight)
    x = at[0] - {"left": 0, "right": width, "centre": width // 2}[align]
    cv2.putText(picture, words, (x, at[1]), colour, _face(), size, weight)
    return width


def text_width(words: str, *, size: int = 17, weight: int = 400) -> int:
    """Width of words as `text` writes them, px."""
    _, _, width, _ = cv2.getTextSize((1, 1), words, (0, 0), _face(), size, weight)
    return int(width)


def colour_bar(picture: Picture, scale: Scale, box: tuple[int, int, int, int]) -> None:
    """An upright bar in box (x, y, width, height), high values on top, with round numbers to its right, in place."""
    x, y, width, height = box
    rows = np.linspace(255, 0, height).round().astype(np.intp)
    picture[y : y + height, x : x + width] = scale.table()[rows][:, None]
    numbers = ticks(scale.low, scale.high)
    places = max((_places(number) for number in numbers), default=0)
    for number in numbers:
        at = y + round((scale.high - number) / (scale.high - scale.low) * (height - 1))
        cv2.line(picture, (x + width, at), (x + width + 4, at), DIM, 1)
        text(picture, grouped(number, places), (x + width + 9, at + 5), size=14, colour=DIM)
    if scale.unit:
        text(picture, scale.unit, (x, y - 10), size=14, colour=DIM)


def grouped(number: float, places: int = 0) -> str:
    """A number with thin groups of three digits: 1 234 567."""
    return f"{number:,.{places}f}".replace(",", " ").replace("-", "−")


def _places(number: float) -> int:
    return next((places for places in range(6) if math.isclose(round(number, places), number, abs_tol=1e-9)), 6)


def _face() -> Any:
    return cv2.FontFace("sans")


def _table(name: ColourMap) -> Picture:
    ramp = np.arange(256, dtype=np.uint8)[:, None]
    if name == "grey":
        return np.repeat(ramp, 3, axis=1)
    if name == "viridis":
        return np.asarray(cv2.applyColorMap(ramp, cv2.COLORMAP_VIRIDIS)[:, 0], dtype=np.uint8)
    at = np.linspace(0, 1, 256)
    places = np.linspace(0, 1, len(_STOPS[name]))
    channels = [np.interp(at, places, [stop[channel] for stop in _STOPS[name]]) for channel in range(3)]
    return np.asarray(np.stack(channels, axis=-1).round(), dtype=np.uint8)


_STOPS: dict[str, tuple[Colour, ...]] = {
    # Blue, near white, red: dark and saturated at both ends alike, light in the middle (after Moreland 2009).
    "diverging": ((128, 58, 30), (214, 160, 96), (238, 238, 238), (98, 140, 232), (44, 20, 140)),
    # Red to orange to a calm green-blue: what can be trusted does not shout.
    "trust": ((50, 40, 170), (60, 110, 226), (110, 180, 240), (160, 176, 140), (150, 150, 70)),
}
