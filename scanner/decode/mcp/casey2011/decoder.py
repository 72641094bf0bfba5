"""The reference decoder: the stages in order, and the maps they leave.

The door is the default decoder's: what a frame must be, and vertical stripes (axis "x") turned into horizontal ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.decode import Decoded
from scanner.decode.mcp.casey2011 import (
    carrier_search,
    channels,
    growth,
    hidden_markov,
    inclination,
    refusals,
    stripe_detection,
)
from scanner.decode.mcp.casey2011.code_to_phase import CodeToPhase, code_to_phase
from scanner.decode.mcp.casey2011.maps import maps_of
from scanner.decode.mcp.casey2011.shown import Shown
from scanner.decode.mcp.decoder import McpDecoder
from scanner.decode.mcp.door import turned_back, upright_image
from scanner.decode.mcp.locate import Stages
from scanner.decode.mcp.model import PatternModel
from scanner.decode.stages import Observer
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, ProjectorSize

PLAIN_AGREEMENT = 0.6
"""Share of code words that fit below which a warning goes with the result: of the reference scenes none."""


class CaseyDecoder(McpDecoder):
    """Takes the one frame of an MCP sequence and decodes it as published.

    `observer` is told the intermediate images, stripes horizontal, like figures 5.4-5.15 (`shown.STAGES`).
    `fit`: see `decode_image`.
    """

    def __init__(
        self,
        sequence: PatternSequence,
        camera: CameraFormat,
        observer: Observer | None = None,
        fit: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(sequence, camera)
        self._observer = observer
        self._fit = fit
        load_kernels()

    def finish(self) -> Decoded:
        """The maps; see `scanner.decode.Decoder`."""
        frame, projector = self.frame(), self._sequence.projector
        return decode_image(frame, self._pattern, projector, self._camera, self._observer, self._fit)


@cache
def load_kernels() -> None:
    """Call every kernel once with the types that frames have.

    Loading them from the cache takes as long as decoding a frame, and compiling them much longer: neither is left to
    the first frame.
    """
    projector = ProjectorSize(256, 192)
    pattern = McpPattern(bits=2, carriers=(20.0, 34.0), codes=(0, 1, 2, 3), levels="composite")
    light = pattern.fringe(0, projector)
    for bits in (8, 12):
        camera = CameraFormat(projector.width, projector.height, bits)
        frame = (10 + light * (0.8 * camera.max_value)).astype(camera.dtype)
        decode_image(frame, pattern, projector, camera)


def decode_image(
    image: NDArray[np.uint8] | NDArray[np.uint16],
    pattern: McpPattern,
    projector: ProjectorSize,
    camera: CameraFormat,
    observer: Observer | None = None,
    fit: Mapping[str, Any] | None = None,
) -> Decoded:
    """Decode one image as published (chapters 4 and 5; fig. 4.1).

    Args:
        image: (H, W) uint8 or uint16, linear camera response, as captured.
        pattern: what was projected.
        projector: size of the projector's image.
        camera: format of `image`.
        observer: told the intermediate images in order, up to the stage that fails if one does; see `shown.STAGES`.
        fit: slope and intercept of the calibration's code-to-phase fit (sec. 3.7), see `code_to_phase`; None: it has
            none, and the pattern's own line is used.

    Returns:
        maps on the camera's grid, with rows on the pixels of stripe peaks, minima and mid-levels only.

    Raises:
        DecodeError: no stripes, other carriers than described, codes that contradict the description, or a pattern
            turned by 90 degrees.
    """
    pattern.validate(projector)
    upright = upright_image(image, pattern, camera)
    model = PatternModel.of(pattern, projector)
    what = _What(pattern, model, camera, code_to_phase(model, fit))
    try:
        decoded = _decode(upright, what, Shown(observer))
    except DecodeError:
        found = _upside_down(upright, what, observer)
        if found is None:
            _refuse_turned(upright, what)
            raise
        decoded = found
    return decoded if pattern.axis == "y" else turned_back(decoded)


@dataclass(frozen=True, eq=False)
class _What:
    """What was projected and how it was captured; phase: projector rows of stripes."""

    pattern: McpPattern
    model: PatternModel
    camera: CameraFormat
    phase: CodeToPhase


def _decode(upright: NDArray[Any], what: _What, show: Shown) -> Decoded:
    """The stages in order (fig. 4.1), stripes horizontal and the first on top."""
    model, phase = what.model, what.phase
    clock = Stages()
    show("input", upright)
    refusals.refuse_flat(upright, what.camera)
    with clock.stage("stripes"):
        found = stripe_detection.detect(upright, model.stripes, model.weakest)
    show("enhanced", found.enhanced)
    show("regions", found.region)
    show.on_peaks("stripes", np.ones(len(found.peaks.y), np.uint8), found)
    refusals.refuse_few(found, upright)
    read = _read_channels(upright, found, model, clock, show)
    named = _name_peaks(read.word, found, what.pattern, model, clock, show)
    with clock.stage("stripes between"):
        light = found.calm[found.peaks.y, found.peaks.column]
        stripe, sure = growth.name_unmodulated(named.stripe, named.sure, found.peaks, light)
        calm = stripe_detection.calmed(upright.astype(np.float32), found.wavelength, across=1)
        marks = growth.name_2x_4x(calm, stripe, sure, found.peaks)
    with clock.stage("maps"):
        decoded = maps_of(upright, found, stripe, marks, phase, what.camera)
    show.on_peaks("all-stripes", stripe + 1, found)
    show.marks(marks, phase, found.region.shape)
    details = {
        **named.figures,
        "pitch_px": round(found.wavelength, 3),
        "intensity_threshold": round(found.threshold, 2),
        "segments": [{"name": s.name, "slope": round(s.slope, 4)} for s in read.segments],
        "carriers": [[round(float(f) * upright.shape[1], 2) for f in s.frequency] for s in read.searches],
        "carrier_contrast": [round(s.contrast, 2) for s in read.searches],
        "peaks": len(found.peaks.y),
        "peaks_decided": int((stripe >= 0).sum()),
        "marks": len(marks.x),
        "code_to_phase": {"slope": phase.slope, "intercept": phase.intercept, "from": phase.source},
        "timings_ms": {name: round(ms, 2) for name, ms in clock.ms.items()},
    }
    said = (*_warnings(details), phase.warning) if phase.warning else _warnings(details)
    return replace(decoded, details=details, warnings=said)


# --- another way up -----------------------------------------------------------------------------------------------


def _upside_down(image: NDArray[Any], what: _What, observer: Observer | None) -> Decoded | None:
    """The maps if the projector or the camera hangs upside down, so that the stripes' order is reversed; else None.

    Ours: the dissertation's rig stands upright.
    """
    try:
        decoded = _decode(np.ascontiguousarray(image[::-1]), what, Shown(observer, "image upside down"))
    except DecodeError:
        return None
    names = ("rows", "sigma_rows", "confidence", "albedo", "modulation", "reason", "stripes")
    flipped: dict[str, Any] = {name: np.ascontiguousarray(getattr(decoded, name)[::-1]) for name in names}
    peaks = decoded.peaks
    assert peaks is not None  # noqa: S101  (of this decoder they always are)
    peaks[:, 1] = len(image) - 1 - peaks[:, 1]
    return replace(decoded, **flipped, peaks=peaks, details={**decoded.details, "upside_down": True})


def _refuse_turned(image: NDArray[Any], what: _What) -> None:
    """Raise DecodeError if the pattern is there, codes and all, once the image is turned. Ours, as in `refusals`."""
    turned = np.ascontiguousarray(image.T)
    for way_up in (turned, np.ascontiguousarray(turned[::-1])):
        try:
            _decode(way_up, what, Shown(None))
        except DecodeError:
            continue
        raise DecodeError(
            "the pattern is turned by 90 degrees: its stripes run the other way",
            hint='the other "axis" in the description, or turn projector or camera',
        )


# --- what is on the peaks -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Read:
    """word: (P,) int32 code word on each peak; what was decoded apart, and the carriers of each."""

    word: NDArray[np.int32]
    segments: list[inclination.Segment]
    searches: list[carrier_search.Search]


def _read_channels(
    image: NDArray[Any],
    found: stripe_detection.Stripes,
    model: PatternModel,
    clock: Stages,
    show: Shown,
) -> _Read:
    """Segments, their carriers and channels; code words on the peaks (sec. 4.2-4.5)."""
    peaks, shape, width = found.peaks, found.region.shape, image.shape[1]
    ascending = np.argsort(model.carriers)
    expected = model.carriers[ascending].astype(np.float64) * model.pitch / found.wavelength
    with clock.stage("inclination"):
        slope = inclination.slopes(peaks, found.wavelength)
        show.on_peaks("slope", slope, found, elsewhere=np.nan)
        limit = inclination.negligible_slope(found.wavelength, float(np.diff(expected).min()))
        parts = inclination.segments(peaks, slope, limit, found.wavelength, shape)
        number = inclination.segment_of(parts, slope, limit)
    several = len(parts) > 1
    word = np.zeros(len(peaks.y), np.int32)
    searches: list[carrier_search.Search] = []
    used: list[inclination.Segment] = []
    grey = image.astype(np.float32)
    grey -= grey.mean()
    for k, part in enumerate(parts):
        with clock.stage("inclination"):
            level = inclination.turned_level(grey, part)
        with clock.stage("carriers"):
            transform = carrier_search.spectrum(level)
            folded = carrier_search.folded_psd(level, found.wavelength)
            search = carrier_search.search(folded, expected, width)
            if k == 0 and not refusals.carriers_match(search, expected):
                search = carrier_search.search(folded, expected, width, near=True)
        title = part.name if several else ""
        show("spectrum", folded, title)
        show("bands", np.stack([search.A, search.B, search.C]), title)
        with clock.stage("carriers"):
            if k == 0:
                refusals.refuse_carriers(search, expected, width)
            alike = k == 0 or np.allclose(search.frequency, searches[0].frequency, rtol=refusals.MATCH)
            if not (alike and refusals.carriers_match(search, expected)):
                # Too little of a stripe for a spectrum of its own (a small object): better read in the whole image.
                continue
            searches.append(search)
            used.append(part)
        with clock.stage("channels"):
            mask = inclination.level_mask(part)
            bits: list[NDArray[np.uint8]] = [np.zeros(shape, np.uint8)] * model.channels
            for i, channel in enumerate(ascending):
                frequency, sigma = float(search.frequency[i]), float(search.sigma[i])
                isolated = channels.isolate(transform, frequency, sigma, found.wavelength, shape)
                binary = channels.binarize(isolated, frequency, mask)
                bits[channel] = inclination.turned_back(binary, part)
                show("channel", isolated, title, f"{channel}")
                show("bits", bits[channel], title, f"{channel}")
            # The first segment reads all peaks; those of a segment of its own are then read again.
            mine = number == k if k > 0 else np.ones(len(word), bool)
            word[mine] = channels.code_words(bits, peaks.y[mine], peaks.column[mine])
    return _Read(word, used, searches)


@dataclass(frozen=True, eq=False)
class _Named:
    """stripe: (P,) int32 index of modulated stripes, -1 none. sure: (P,) float32. figures for the report."""

    stripe: NDArray[np.int32]
    sure: NDArray[np.float32]
    figures: dict[str, Any]


def _name_peaks(
    word: NDArray[np.int32],
    found: stripe_detection.Stripes,
    pattern: McpPattern,
    model: PatternModel,
    clock: Stages,
    show: Shown,
) -> _Named:
    """Hidden Markov model and what follows it, on modulated stripes (sec. 4.5, 5.2-5.5)."""
    peaks, wavelength, shape = found.peaks, found.wavelength, found.region.shape
    stripes = np.array([s for s in range(model.stripes) if pattern.code_of(s)], np.int32)
    symbols = np.array([pattern.code_of(int(s)) for s in stripes], np.int32)
    lit = int((model.level > 0).sum())
    show.on_peaks("code", word, found)
    with clock.stage("modal filter"):
        # "Modal filtering could often improve results of further processing steps" (sec. 5.5): the model is given the
        # filtered code words, as for tables 5.1 and 5.2.
        word = growth.modal_filter(word, peaks, wavelength)
        show.on_peaks("code-modal", word, found)
    with clock.stage("hidden Markov model"):
        expected = (model.ratio > 0).sum(axis=0) / lit
        miss = channels.miss_rates(word, expected)
        false = np.full(model.channels, channels.FALSE_POSITIVE)
        known = hidden_markov.model(symbols, false, miss)
        path = hidden_markov.best_paths(word, peaks.start, known)
        sure = hidden_markov.posteriors(word, peaks.start, path, known)
    as_word = np.concatenate(([0], symbols)).astype(np.int32)
    show.on_peaks("hmm", as_word[path], found)
    with clock.stage("agreement"):
        agreement = hidden_markov.fitting(word, path, symbols)
        chance = refusals.refuse_order(agreement, word, peaks, symbols, (false, miss))
    with clock.stage("modal filter"):
        modal = growth.modal_filter(path, peaks, wavelength)
    show.on_peaks("hmm-modal", as_word[modal], found)
    with clock.stage("blobs"):
        period = wavelength / (model.pitch * float(model.carriers.min()))
        beat = wavelength / (model.pitch * model.separation)
        solid = growth.eliminate_blobs(modal, peaks, shape, wavelength, round(period), round(beat / 2))
    show.on_peaks("blobs", as_word[solid], found)
    with clock.stage("growth"):
        grown, mask = growth.grow(solid, peaks, found.region, wavelength)
    show("growth-mask", mask)
    show.on_peaks("grown", as_word[grown], found)
    own = (grown == path) & (path > 0)
    usual = float(sure[own].mean()) if own.any() else 0.0
    sure = np.where(own, sure, np.where(grown > 0, usual, 0)).astype(np.float32)
    index = np.concatenate(([-1], stripes)).astype(np.int32)[grown]
    figures = {
        "miss_rates": [round(float(m), 4) for m in miss],
        "agreement": round(agreement, 4),
        "agreement_by_chance": round(chance, 4),
    }
    return _Named(index, sure, figures)


YARDSTICK = (
    "the published decoder (Casey 2011), a yardstick: nothing is taken out that is not taken out there, so that "
    "stripes with a wrong name stay, centimetres to decimetres off; its confidence is the posterior of its hidden "
    "Markov model, which does not know them; that of the default decoder does"
)


def _warnings(details: dict[str, Any]) -> tuple[str, ...]:
    said = [YARDSTICK]
    if details["marks"] == 0:
        said.append("stripes and carriers are there, but no stripe could be decided")
    if details["agreement"] < PLAIN_AGREEMENT:
        said.append(
            f"only {details['agreement']:.0%} of the code words fit the description: this decoder knows one frequency "
            "for each carrier, and strong keystone or texture need the default decoder"
        )
    return tuple(said)
