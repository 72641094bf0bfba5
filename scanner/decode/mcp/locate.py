"""Is the pattern there, and at what size: stripes, chains and carriers, or the reason why not.

Nothing is decoded here. What is refused: images without contrast, stripes too fine, another period structure than the
pattern's, stripes without its carriers. Whether the codes are the ones described shows only once they are decoded.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode.mcp import carriers, linking, magnification, stripes
from scanner.decode.mcp.model import PatternModel
from scanner.decode.mcp.ranks import quantiles
from scanner.decode.mcp.signals import Signals, signals_along
from scanner.decode.mcp.tracks import Tracks, join
from scanner.patterns import CameraFormat

Array = NDArray[np.float32]
Image = NDArray[Any]

MIN_CONTRAST = 1.25
"""Least ratio of a carrier's amplitude to what lies between the carriers, in the mean over the channels."""

TOLD_CONTRAST = 1.1
"""The same where a calibration tells the shape of the projector's pixels, so that print cannot choose another one: what
its codes are worth shows when they are decoded."""

PLAIN_CONTRAST = 1.5
"""Contrast at which no other pitch is tried: noise and texture alone stay below 1.2."""

PITCHES_TRIED = 3
"""Candidates for the pitch: the stripes', and two that texture may offer."""

ASPECTS = (0.5, 2.0)
"""Along the stripes over across them, of projector pixels that are not square: mirrors that stand on their corners make
columns twice as wide as rows are high. `carriers.SCALE_RANGE` about a pixel twice as wide leaves nothing for a surface
that is tilted too. Tried where square pixels bring no carriers to light."""

EVEN = 1.25
"""Ratio of the peaks' median distance to the pitch, or the inverse, up to which they go together: keystone and texture
take less, and a pattern taken for half or twice as fine is off by two."""

NEAR = 0.06
"""Change of the stripes' distance, relative, up to which pitch and carriers of a frame before serve."""

MIN_PITCH_MATCH = 0.35
"""Least correlation of the image's and the pattern's spectrum along the phase direction."""


class Stages:
    """Time of each stage, ms."""

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of the block to `name`."""
        begin = time.perf_counter()
        yield
        self.ms[name] = self.ms.get(name, 0.0) + 1e3 * (time.perf_counter() - begin)


@dataclass
class Found:
    """What the search for stripes and carriers found; `fault` says why it is no pattern, if it is none.

    even: the peaks lie about as far apart as the pitch says. beyond: (P,) peaks past an object's edge, see
    `linking.silhouettes`.
    """

    fault: str | None = None
    hint: str | None = None
    reduced: Array = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    noise: float = 0.0
    pitch: float = 0.0
    match: float = 0.0
    contrast: float = 0.0
    even: bool = True
    beyond: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    peaks: stripes.Peaks | None = None
    chains: linking.Chains | None = None
    tracks: Tracks | None = None
    signals: Signals | None = None
    search: carriers.CarrierSearch | None = None

    @property
    def plain(self) -> bool:
        """Nothing else need be tried: stripes as far apart as the pitch says, and all of the carriers on them."""
        each = (0.0,) if self.search is None else self.search.contrast
        return self.even and self.contrast >= PLAIN_CONTRAST and min(each) >= 1

    @property
    def rank(self) -> tuple[bool, float]:
        """By which trials are compared: by all carriers, none for more than a factor of three, and the weakest again.

        Two strong ones among four are another set's, or texture's.
        """
        each = (0.1,) if self.search is None else self.search.contrast
        logs = np.log(np.clip(each, 0.1, 3.0))
        return self.even, float(logs.mean() + logs.min())

    def parts(
        self,
    ) -> tuple[stripes.Peaks, linking.Chains, Tracks, Signals, carriers.CarrierSearch]:
        """What a search without a fault has found."""
        assert self.peaks is not None  # noqa: S101  (no fault means that the search went to its end)
        assert self.chains is not None  # noqa: S101
        assert self.tracks is not None  # noqa: S101
        assert self.signals is not None  # noqa: S101
        assert self.search is not None  # noqa: S101
        return self.peaks, self.chains, self.tracks, self.signals, self.search


@dataclass(frozen=True)
class Known:
    """What one frame teaches of the next: pitch and carriers, and how well the frame agreed with them.

    upside_down: the image is turned before. spacing: decoded stripes' median distance, px. magnification: median of the
    field about the search's own. hits: as in `description.Agreement`. decided: share of the peaks with a stripe.
    """

    pitch: float
    match: float
    search: carriers.CarrierSearch
    upside_down: bool
    spacing: float
    magnification: float
    hits: float
    decided: float

    def still_holds(self, now: Known) -> bool:
        """Whether a frame decoded by this knowledge shows what it was learnt from.

        A surface nearer or further by an eighth changes spacing and magnification by that; pitch windows and the field
        (`magnification.FIELD_RANGE`) take half of it. Fewer carriers or stripes than there were ask for a new search.
        """
        near = abs(now.spacing / self.spacing - 1) < NEAR and abs(now.magnification - self.magnification) < NEAR / 2
        return near and now.hits >= 0.9 * self.hits and now.decided >= 0.7 * self.decided


def locate(
    image: Image,
    model: PatternModel,
    camera: CameraFormat,
    clock: Stages,
    known: Known | None = None,
    aspects: tuple[float, ...] = ASPECTS,
    told: float | None = None,
) -> Found:
    """Find stripes and carriers.

    Args:
        image: (H, W), stripes horizontal.
        model: the pattern's tables.
        camera: the frame's format.
        clock: takes the stages' times.
        known: of a frame before: no pitch and no carriers are searched then.
        aspects: shapes of the projector's pixels that are tried besides square ones.
        told: their shape, where a calibration tells it; no other is tried then.

    Returns:
        what was found; its `fault` says why there is no pattern, if there is none.
    """
    with clock.stage("columns"):
        found = Found(reduced=stripes.reduce_columns(image))
        found.noise = max(stripes.noise_of(found.reduced), 1e-3)
    low, high = quantiles(found.reduced[::4, ::4], 0.01, 0.99)
    if high - low < max(0.01 * camera.max_value, 6 * found.noise):
        state = "black" if high < 0.1 * camera.max_value else "saturated" if low > 0.9 * camera.max_value else "uniform"
        state = f"{state} but for noise of {found.noise:.1f}" if found.noise > 0.01 * camera.max_value else state
        found.fault = f"no pattern: the image is {state} (grey levels {low:.0f} to {high:.0f})"
        found.hint = "check that the projector shows the pattern, its focus, and the exposure"
        return found
    if known is not None:
        known_here = replace(found, pitch=known.pitch, match=known.match, search=known.search)
        return _search(known_here, image, model, camera, clock, known.search.aspect)
    with clock.stage("pitch"):
        candidates = stripes.estimate_pitch(found.reduced, model, PITCHES_TRIED)
    best: Found | None = None
    least = MIN_CONTRAST if told is None else TOLD_CONTRAST
    for pitch, match in candidates:
        trial = _search(
            replace(found, pitch=pitch, match=match), image, model, camera, clock, told or 1.0, least_contrast=least
        )
        if trial.plain:
            return trial
        best = trial if best is None or trial.rank > best.rank else best
    for aspect in aspects if told is None else ():
        pitch, match = candidates[0]
        trial = _search(replace(found, pitch=pitch, match=match), image, model, camera, clock, aspect)
        if trial.plain:
            return trial
        best = trial if best is None or (trial.rank > best.rank and trial.contrast >= PLAIN_CONTRAST) else best
    return best or found


def _search(
    found: Found,
    image: Image,
    model: PatternModel,
    camera: CameraFormat,
    clock: Stages,
    aspect: float = 1.0,
    *,
    least_contrast: float = MIN_CONTRAST,
) -> Found:
    """Stripes and carriers at one candidate's pitch, the projector's pixels `aspect` times as wide as high."""
    if found.match < MIN_PITCH_MATCH:
        found.fault = f"no stripes of this pattern (spectra agree to {found.match:.2f})"
        return found
    if found.pitch < stripes.MIN_PITCH_PX:
        found.fault = f"stripes are {found.pitch:.1f} px apart, too fine for this camera"
        found.hint = "project fewer bits, or move the camera closer"
        return found
    around = aspect * found.pitch / model.pitch
    with clock.stage("peaks"):
        longest = around / float(model.carriers.min())
        found.peaks = stripes.find_peaks(found.reduced, found.pitch, longest, found.noise, model.weakest)
        found.even = 1 / EVEN < stripes.spacing(found.peaks) / found.pitch < EVEN
    with clock.stage("chains"):
        found.chains = linking.link(found.peaks, found.pitch)
        beyond = np.zeros(0, np.bool_)
        if carriers.are_short(found.chains, model, around):
            beyond = linking.silhouettes(found.reduced, found.peaks, found.chains)
        if beyond.any():
            # Of a narrow object what smoothing draws out past its edges is too large a share.
            found.peaks = found.peaks.where(~beyond)
            found.chains = linking.link(found.peaks, found.pitch)
        long = magnification.window_px(model, around) // stripes.STEP
        found.tracks = join(found.peaks, found.chains, found.pitch, long)
        found.beyond = np.zeros(len(found.peaks), np.bool_)
        if not beyond.any():
            found.beyond = linking.silhouettes(found.reduced, found.peaks, found.tracks.links)
        found.signals = signals_along(image, found.tracks, found.pitch, longest, camera.max_value)
    if len(found.peaks) == 0:
        found.fault = "no stripes stand out of the noise"
        return found
    if found.search is not None:
        return found
    with clock.stage("carriers"):
        shape = image.shape[0], image.shape[1]
        found.search = replace(
            carriers.search_carriers(found.signals, found.tracks, model, around, shape), aspect=aspect
        )
    found.contrast = float(np.exp(np.log(np.maximum(found.search.contrast, 0.1)).mean()))
    if found.contrast < least_contrast:
        shown = ", ".join(f"{c:.2f}" for c in found.search.contrast)
        found.fault = f"stripes {found.pitch:.1f} px apart, but not the carriers described (contrasts {shown})"
        found.hint = "check bits and carriers of the description, and focus"
    return found
