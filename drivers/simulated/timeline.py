"""What shone when: the projector's images over time, and the share each has in an exposure.

Times are nanoseconds of the world's clock. Each image begins to shine at its change and ends at the next one; with
a sweep the change runs down the picture, and a pixel takes the ramp to change over. Nothing here knows of scenes.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from drivers.simulated.optics import Image, Light, Plane, flat_axis, grid_of_light, line_of_light

HISTORY = 4096
"""Changes remembered: more than any camera's buffers reach back"""

BEGINNING_NS = -1e18
"""Dark since then: before any clock's time, and finite, so that differences are numbers"""


class LoadedImage:
    """One image in the projector's memory, and its light once somebody looked."""

    def __init__(self, image: Image) -> None:
        self._axis = flat_axis(image)
        if self._axis == "row":
            self._values = image[:, 0].copy()
        elif self._axis == "column":
            self._values = image[0].copy()
        else:
            self._values = image.copy()
        self._light: tuple[int, float, Light] | None = None

    @classmethod
    def of(cls, axis: Literal["row", "column"] | None, values: Image) -> LoadedImage:
        """The image whose `content` is (axis, values)."""
        found = cls(np.zeros((1, 1), dtype=np.uint8))
        found._axis, found._values = axis, values
        return found

    def content(self) -> tuple[Literal["row", "column"] | None, Image]:
        """The axis along which its values lie, and they; None: all of its pixels."""
        return self._axis, self._values

    def light(self, response: Plane, sigma_px: float, keep: bool = True) -> Light:
        """The image's light for a response (256,) of the projector. keep: for the next time, too."""
        if self._light is not None and self._light[:2] == (id(response), sigma_px):
            return self._light[2]
        light: Light
        if self._axis is None:
            light = grid_of_light(self._values, response, sigma_px)
        else:
            light = line_of_light(self._values, response, sigma_px, self._axis)
        if keep:
            self._light = (id(response), sigma_px, light)
        return light

    @property
    def is_flat(self) -> bool:
        """Constant along one axis: its light is small."""
        return self._axis is not None

    def forget_light(self) -> None:
        """Free the light of an image that is not shown any more."""
        self._light = None


@dataclass(frozen=True)
class Manner:
    """How the projector changes from one image to the next, ns. period 0: constant light."""

    sweep_ns: float = 0.0
    ramp_ns: float = 0.0
    period_ns: int = 0
    """pulse width modulation: a light of g shines for the first g of each period"""
    phase_ns: int = 0
    """when one of the periods began"""


@dataclass(frozen=True, eq=False)
class Segment:
    """An image within an exposure: it begins to shine at `on_ns`, the next one at `off_ns` (inf: none yet)."""

    image: LoadedImage | None
    on_ns: float
    off_ns: float


class Timeline:
    """The projector's images in time; dark before the first. Written by the projector, read by the camera."""

    def __init__(self) -> None:
        self.manner = Manner()
        self.changes = 0
        """so many so far: who looked ahead sees whether that still holds"""
        self._changes: deque[tuple[float, LoadedImage | None]] = deque([(BEGINNING_NS, None)], maxlen=HISTORY)
        self._lock = threading.Lock()
        self.told: Callable[[float, LoadedImage | None], None] | None = None
        """hears of every change, too"""

    def show(self, t_ns: int, image: LoadedImage | None) -> None:
        """`image` (None: black) begins to shine at `t_ns`, not before the change before."""
        with self._lock:
            last = self._changes[-1][0]
            self._changes.append((max(float(t_ns), last), image))
            self.changes += 1
        if self.told is not None:
            self.told(t_ns, image)

    def between(self, start_ns: float, end_ns: float) -> list[Segment]:
        """The images that shine, wholly or while changing, within [start_ns, end_ns]; in order, one at least."""
        with self._lock:
            changes = list(self._changes)
        slow = self.manner.sweep_ns + self.manner.ramp_ns
        found: list[Segment] = []
        off = np.inf
        for on, image in reversed(changes):
            if on < end_ns:
                found.append(Segment(image, on, off))
            if on + slow <= start_ns:
                break
            off = on
        return found[::-1] or [Segment(None, BEGINNING_NS, off)]


def share(manner: Manner, segment: Segment, start: NDArray[np.float64], end: NDArray[np.float64], down: Plane) -> Plane:
    """Share of an exposure in which the segment's image shines.

    Args:
        manner: of the projector.
        segment: the image and its times.
        start, end: of the exposure, ns relative to any origin `segment` uses; broadcast against `down`.
        down: how far down the projected picture, 0..1.

    Returns:
        float32 of the broadcast shape, 0..1.
    """
    # From the exposure's own start: single precision, which `down` has, holds no time since the machine's start.
    origin = float(np.min(start))
    start, end, sweep = start - origin, end - origin, manner.sweep_ns * down
    begun = _risen(segment.on_ns - origin + sweep, manner.ramp_ns, start, end)
    ended = _risen(segment.off_ns - origin + sweep, manner.ramp_ns, start, end)
    return np.asarray((begun - ended) / (end - start), dtype=np.float32)


def pulsed_response(response: Plane, manner: Manner, segment: Segment, start_ns: float, end_ns: float) -> Plane:
    """Light of each value over an exposure where greys are pulses: (256,) float32, share of the whole exposure.

    The change-over is taken at the middle of the ramp, which is shorter than a pulse on such projectors.
    """
    half = manner.ramp_ns / 2
    first, last = max(start_ns, segment.on_ns + half), min(end_ns, segment.off_ns + half)
    if last <= first:
        return np.zeros_like(response)
    on = _pulse_time(response, manner, last) - _pulse_time(response, manner, first)
    return np.asarray(on / (end_ns - start_ns), dtype=np.float32)


def bands(start_ns: float, readout_ns: float, height: int, margin: int, count: int) -> Iterator[tuple[slice, float]]:
    """Bands of rows of a rolling exposure that are taken as exposed together: rows, and their start, ns.

    height: of the sensor. margin: rows above and below it, which are exposed with the first and the last band.
    """
    edges = np.linspace(0, height, min(count, height) + 1).astype(int)
    for low, high in pairwise(edges):
        begin = start_ns + readout_ns * ((low + high - 1) / 2) / max(height - 1, 1)
        rows = slice(int(low) + margin if low else 0, int(high) + (margin if high < height else 2 * margin))
        yield rows, begin


def _pulse_time(response: Plane, manner: Manner, t_ns: float) -> NDArray[np.float64]:
    """Time that each value has shone from the phase's origin until `t_ns`, ns."""
    whole, within = divmod(t_ns - manner.phase_ns, manner.period_ns)
    pulse = response.astype(np.float64) * manner.period_ns
    return np.asarray(whole * pulse + np.minimum(within, pulse))


def _risen(
    t0: NDArray[Any] | float, ramp: float, start: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Integral over [start, end] of a step at t0 that takes `ramp` to rise, ns."""
    return np.asarray(_area(end - t0, ramp) - _area(start - t0, ramp))


def _area(t: NDArray[np.float64], ramp: float) -> NDArray[np.float64]:
    """Integral of the step up to t after its beginning."""
    after = np.maximum(t, 0.0)
    if ramp <= 0:
        return after
    return np.where(after < ramp, after * np.minimum(after, ramp) / (2 * ramp), after - ramp / 2)
