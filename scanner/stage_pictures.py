"""Pictures of a decoder's stages: each `scanner.decode.stages.Stage` as an image file, numbered in order.

A picture shows the stage at its own size, as it is; curves and dots are drawn with axes. Nothing is measured here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.colours import BACKGROUND, DIM, LINE, PANEL, Colour, Picture, Scale, text, ticks
from scanner.decode.stages import Look, Stage
from scanner.errors import StorageError
from scanner.storage import replace_file, replace_json

INDEX = "stages.json"

PLOT_SIZE = (1200, 640)
"""Width and height of plots, px"""

SPARSE = 0.2
"""Masks and labels that cover less than this share are lines one pixel wide: they are drawn three wide, to be seen."""

CURVE_COLOURS: tuple[Colour, ...] = ((230, 180, 90), (120, 196, 255), (130, 220, 150), (200, 150, 230))


class StageFolder:
    """An observer that writes each stage it is told as `NN-name.png`, and `stages.json` with titles and sources.

    The folder exists. After a decoder failed it holds the stages up to the failure.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.written: list[dict[str, str]] = []

    def __call__(self, stage: Stage) -> None:
        """Draw and write one stage.

        Raises:
            StorageError: the folder cannot be written.
        """
        name = f"{len(self.written) + 1:02d}-{stage.name}.png"
        whole, encoded = cv2.imencode(".png", stage_picture(stage))
        if not whole:
            raise StorageError(f"{self._folder / name}: the picture could not be encoded")
        replace_file(self._folder / name, encoded.tobytes())
        self.written.append({"file": name, "name": stage.name, "title": stage.title, "source": stage.source})
        replace_json(self._folder / INDEX, {"format": "fringed-stages", "version": 1, "stages": self.written})


def stage_picture(stage: Stage) -> Picture:
    """(h, w, 3) uint8 BGR."""
    return _DRAWN[stage.look](stage.values)


def label_colours(most: int) -> Picture:
    """(most + 1, 3) BGR: 0 the background; neighbouring labels far apart in hue (steps of the golden angle)."""
    label = np.arange(most + 1)
    hsv = np.empty((1, most + 1, 3), np.uint8)
    hsv[0, :, 0] = np.round(label * 137.508 / 2) % 180
    hsv[0, :, 1] = np.where(label % 2, 220, 150)
    hsv[0, :, 2] = 255
    table = np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0], np.uint8)
    table[0] = BACKGROUND
    return table


def _grey(values: NDArray[Any]) -> Picture:
    low, high = (float(v) for v in np.percentile(values, (0.1, 99.9)))
    return Scale(low, max(high, low + 1), "grey").apply(values)


def _signed(values: NDArray[Any]) -> Picture:
    there = np.abs(values[np.isfinite(values)])
    limit = max(float(np.percentile(there, 99)) if there.size else 0.0, 1e-6)
    thin = np.isfinite(values).mean() < SPARSE
    filled = _thicker(values) if thin else values
    return Scale(-limit, limit, "diverging").apply(filled, missing=BACKGROUND)


def _thicker(values: NDArray[Any]) -> NDArray[Any]:
    """Each value repeated above and below where nothing is."""
    out = np.array(values)
    for one, other in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
        empty = np.isnan(out[one]) & np.isfinite(values[other])
        out[one][empty] = values[other][empty]
    return out


def _mask(values: NDArray[Any]) -> Picture:
    high = values > 0
    wide = high.astype(np.uint8)
    if high.mean() < SPARSE:
        wide = np.asarray(cv2.dilate(wide, np.ones((3, 1), np.uint8)))
    return np.array((BACKGROUND, (235, 235, 235)), np.uint8)[wide]


def _labels(values: NDArray[Any]) -> Picture:
    wide = np.asarray(cv2.dilate(values.astype(np.int16), np.ones((3, 1), np.uint8)))
    return np.asarray(label_colours(int(values.max(initial=0)))[wide])


def _spectrum(values: NDArray[Any]) -> Picture:
    """Decades below the largest value without DC's own column, three pixels high for each vertical frequency."""
    decades = np.log10(np.maximum(values, 1e-30))
    high = float(np.percentile(decades, 99.9))
    picture = Scale(high - 4, high, "viridis").apply(decades)
    return np.repeat(picture, 3, axis=0)


def _curves(values: NDArray[Any]) -> Picture:
    """One panel for each curve, over the same abscissa, DC's flank cut off at the top."""
    width, height = PLOT_SIZE
    picture = np.full((height, width, 3), BACKGROUND, np.uint8)
    count = len(values)
    # What lies beside DC is orders of magnitude above the bands; the scale is that of the upper nine tenths.
    beyond = values[0][values.shape[1] // 20 :]
    top = 1.1 * float(beyond.max(initial=0)) or 1.0
    for k, curve in enumerate(values):
        box = (60, 12 + k * (height - 40) // count, width - 80, (height - 40) // count - 12)
        _axes(picture, box, (0.0, len(curve) - 1.0), None, numbers=k == count - 1)
        x, y, w, h = box
        at = np.stack([x + np.arange(len(curve)) * (w / (len(curve) - 1)), y + h * (1 - np.clip(curve / top, 0, 1))])
        line = np.rint(at.T).astype(np.int32)
        cv2.polylines(picture, [line], False, CURVE_COLOURS[k % len(CURVE_COLOURS)], 2, cv2.LINE_AA)
        text(picture, "ABCDEFGH"[k], (22, y + h // 2), size=22, weight=600)
    text(picture, "cycles per image", (width - 20, height - 6), size=14, colour=DIM, align="right")
    return picture


def _dots(values: NDArray[Any]) -> Picture:
    width, height = PLOT_SIZE
    picture = np.full((height, width, 3), BACKGROUND, np.uint8)
    box = (80, 16, width - 100, height - 60)
    x, y, w, h = box
    if values.shape[1] == 0:
        text(picture, "nothing decoded along this column", (width // 2, height // 2), colour=DIM, align="centre")
        return picture
    limits = [(float(v.min()), max(float(v.max()), float(v.min()) + 1)) for v in values]
    _axes(picture, box, limits[0], limits[1])
    share = [(v - low) / (high - low) for v, (low, high) in zip(values, limits, strict=True)]
    for u, v in zip(*share, strict=True):
        cv2.circle(picture, (round(x + u * w), round(y + (1 - v) * h)), 3, CURVE_COLOURS[1], -1, cv2.LINE_AA)
    text(picture, "image row", (width - 20, height - 6), size=14, colour=DIM, align="right")
    return picture


def _axes(
    picture: Picture,
    box: tuple[int, int, int, int],
    across: tuple[float, float],
    up: tuple[float, float] | None,
    *,
    numbers: bool = True,
) -> None:
    """A frame with lines at round numbers, told below if `numbers`, and at the left if `up` is given."""
    x, y, w, h = box
    picture[y : y + h, x : x + w] = PANEL
    for number in ticks(*across, most=12):
        at = x + round((number - across[0]) / (across[1] - across[0]) * w)
        cv2.line(picture, (at, y), (at, y + h), LINE, 1)
        if numbers:
            text(picture, f"{number:g}", (at, y + h + 16), size=13, colour=DIM, align="centre")
    for number in ticks(*up) if up is not None else ():
        assert up is not None  # noqa: S101
        at = y + round((up[1] - number) / (up[1] - up[0]) * h)
        cv2.line(picture, (x, at), (x + w, at), LINE, 1)
        text(picture, f"{number:g}", (x - 8, at + 5), size=13, colour=DIM, align="right")


_DRAWN: Mapping[Look, Callable[[NDArray[Any]], Picture]] = {
    Look.GREY: _grey,
    Look.SIGNED: _signed,
    Look.MASK: _mask,
    Look.LABELS: _labels,
    Look.SPECTRUM: _spectrum,
    Look.CURVES: _curves,
    Look.DOTS: _dots,
}
