"""The default MCP decoder: one image in, maps out; the stages in order.

Vertical stripes (axis "x") are turned into horizontal ones at the door and back at the end, so that one code serves
both phase directions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.decode import Decoded, Reason
from scanner.decode.frames import FrameCheck
from scanner.decode.mcp import dense, emissions, hmm, linking, magnification, stripes, subpixel
from scanner.decode.mcp.locate import Array, Found, Image, Known, Stages, locate
from scanner.decode.mcp.model import PatternModel
from scanner.decode.mcp.white import RATIO_BITS, divided, in_grey_levels
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, ProjectorSize

ROUNDS = 2
"""Passes of columns and stripes over one another; a third changed no figure of the reference scenes by .001."""

VOTE_GAIN = 1.5
"""Worth of the neighbours along a stripe, in votes of the peak itself."""

POSTERIOR_FLOOR = 1e-4
"""No vote against a stripe counts for more than this."""

DECIDED = 0.9
"""Posterior below which a peak stays undecided."""

MIN_CHAIN_PX = 16
"""Shorter pieces of stripe are left undecided: less than one period of a carrier, they have no code of their own."""

SWITCH_COST = 6.0
"""Natural logarithm of the odds against a change of stripe between two columns of one chain."""


def decode_image(
    image: NDArray[np.uint8] | NDArray[np.uint16],
    pattern: McpPattern,
    projector: ProjectorSize,
    camera: CameraFormat,
) -> Decoded:
    """Decode one image.

    Args:
        image: (H, W) uint8 or uint16, linear camera response, as captured.
        pattern: what was projected.
        projector: size of the projector's image.
        camera: format of `image`.

    Returns:
        maps on the camera's grid. All NaN, with a warning, where stripes and carriers are there but no stripe could
        be decided.

    Raises:
        DecodeError: no pattern, another pattern, one turned by 90 degrees, or stripes too fine for the camera.
    """
    return decode_next(image, pattern, projector, camera, None)[0]


def decode_next(
    image: NDArray[np.uint8] | NDArray[np.uint16],
    pattern: McpPattern,
    projector: ProjectorSize,
    camera: CameraFormat,
    known: Known | None,
) -> tuple[Decoded, Known]:
    """Decode one image of a series.

    Args:
        image, pattern, projector, camera: as for `decode_image`.
        known: what the frame before taught; None, or where it does not hold any more: everything is searched anew.

    Returns:
        the maps, and what the next frame may use.

    Raises:
        DecodeError: as `decode_image`.
    """
    pattern.validate(projector)
    upright = upright_image(image, pattern, camera)
    model = PatternModel.of(pattern, projector)
    result = None if known is None else _by_what_is_known(upright, model, camera, known)
    decoded, learnt = result or _decode_anew(upright, model, camera)
    return decoded if pattern.axis == "y" else turned_back(decoded), learnt


def _by_what_is_known(
    upright: Image, model: PatternModel, camera: CameraFormat, known: Known
) -> tuple[Decoded, Known] | None:
    """None where it does not hold any more."""
    clock = Stages()
    seen = np.ascontiguousarray(upright[::-1]) if known.upside_down else upright
    found = locate(seen, model, camera, clock, known)
    if found.fault is not None:
        return None
    decided = _decide(found, model, clock)
    if not decided.agreement.holds or not known.still_holds(_learnt(found, decided, upside_down=known.upside_down)):
        return None
    decoded = _maps(seen, found, decided, model, clock)
    return _upside_down(decoded) if known.upside_down else decoded, known


def _decode_anew(upright: Image, model: PatternModel, camera: CameraFormat) -> tuple[Decoded, Known]:
    clock = Stages()
    found = locate(upright, model, camera, clock)
    if found.fault is not None:
        _explain(found, upright, model, camera)
    decided = _decide(found, model, clock)
    if decided.agreement.holds:
        return _maps(upright, found, decided, model, clock), _learnt(found, decided, upside_down=False)
    # The projector may hang upside down: then the stripes' order is reversed.
    turned = np.ascontiguousarray(upright[::-1])
    found = locate(turned, model, camera, clock)
    again = _decide(found, model, clock) if found.fault is None else decided
    if again.agreement.holds:
        return _upside_down(_maps(turned, found, again, model, clock)), _learnt(found, again, upside_down=True)
    _refuse_turned(upright, model, camera)
    a = decided.agreement
    raise DecodeError(
        "stripes and carriers are there, but the codes contradict the description "
        f"(of {a.clear:.0%} clear code words {a.agree:.0%} fit, {a.order:.0%} of neighbours are in order)",
        hint="check bits, carriers, codes and axis of the description against what is projected",
    )


def _learnt(found: Found, decided: _Decision, *, upside_down: bool) -> Known:
    peaks, search = found.peaks, found.search
    assert peaks is not None  # noqa: S101  (as in `_decide`)
    assert search is not None  # noqa: S101
    label = decided.label
    follow = (label[:-1] >= 0) & (label[1:] == label[:-1] + 1)
    spacing = np.diff(peaks.y)[follow]
    spacing = spacing[spacing > 0]  # not from the foot of one column to the head of the next
    return Known(
        found.pitch,
        found.match,
        search,
        upside_down,
        float(np.median(spacing)) if spacing.size else found.pitch,
        decided.magnification,
        decided.agreement.hits,
        float((label >= 0).mean()) if label.size else 0.0,
    )


class McpDecoder:
    """Takes the one frame of an MCP sequence (and its white and black ones, if any) and decodes it.

    In a series, `next_frame` after each `finish` keeps what the frame taught: pitch and carriers are searched again
    only when they do not hold any more, after a change of scene or of distance.

    Raises:
        DecodeError: the sequence is not MCP.
    """

    def __init__(self, sequence: PatternSequence, camera: CameraFormat) -> None:
        if not isinstance(sequence.pattern, McpPattern):
            raise DecodeError(f"the MCP decoder was given method {sequence.pattern.method!r}")
        self._sequence = sequence
        self._pattern = sequence.pattern
        self._camera = camera
        self._known: Known | None = None
        self.next_frame()

    def next_frame(self) -> None:
        """Forget the frames taken, keep what they taught; see `scanner.decode.SeriesDecoder`."""
        self._check = FrameCheck(self._sequence, self._camera)
        self._image: NDArray[Any] | None = None
        self._black: NDArray[Any] | None = None
        self._white: NDArray[Any] | None = None

    def add(self, position: int, frame: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
        """Take the frame at `position`; see `scanner.decode.Decoder`."""
        self._check.take(position, frame)
        if position == self._sequence.fringes[0]:
            self._image = frame.copy()
        elif position == self._sequence.black:
            self._black = frame.copy()
        elif position == self._sequence.white:
            self._white = frame.copy()

    def finish(self) -> Decoded:
        """The maps; see `scanner.decode.Decoder`."""
        known, self._known = self._known, None  # a frame that is refused teaches nothing
        size = self._sequence.projector
        if self._white is None:
            decoded, self._known = decode_next(self.frame(), self._pattern, size, self._camera, known)
            return decoded
        image, white, black = (
            None if frame is None else grey(frame, self._camera) for frame in (self._image, self._white, self._black)
        )
        if image is None or white is None:
            self.frame()
            raise AssertionError("frame() raises without the MCP frame")
        camera = CameraFormat(self._camera.width, self._camera.height, RATIO_BITS)
        ratio = divided(image, white, black, self._camera.max_value)
        decoded, self._known = decode_next(ratio, self._pattern, size, camera, known)
        return replace(
            decoded,
            albedo=in_grey_levels(decoded.albedo, white, black),
            modulation=in_grey_levels(decoded.modulation, white, black),
            details={**decoded.details, "divided_by_white": True},
        )

    def frame(self) -> NDArray[Any]:
        """The one frame, the black one taken off where there is one.

        Raises:
            DecodeError: it has not come.
        """
        if self._image is None:
            raise DecodeError("the MCP frame is missing", hint=f"it is frame {self._sequence.fringes[0]}")
        return self._image if self._black is None else cv2.subtract(self._image, self._black)


# --- the door -----------------------------------------------------------------------------------------------------


def _check_frame(frame: NDArray[Any], camera: CameraFormat, position: int) -> None:
    if frame.ndim != 2:
        raise DecodeError(
            f"frame {position} has shape {frame.shape}, expected one channel", hint="convert it to luma first"
        )
    if frame.shape != camera.shape:
        raise DecodeError(
            f"frame {position} is {frame.shape[1]} x {frame.shape[0]}, "
            f"the camera's format is {camera.width} x {camera.height}"
        )
    if frame.dtype not in (np.uint8, np.uint16):
        raise DecodeError(f"frame {position} has dtype {frame.dtype}, expected uint8 or uint16")


_MOSAICS = {
    "RGGB": cv2.COLOR_BayerRGGB2GRAY,
    "BGGR": cv2.COLOR_BayerBGGR2GRAY,
    "GRBG": cv2.COLOR_BayerGRBG2GRAY,
    "GBRG": cv2.COLOR_BayerGBRG2GRAY,
}


def grey(image: NDArray[Any], camera: CameraFormat) -> Image:
    """One channel of light: a colour camera's mosaic is interpolated.

    Raises:
        DecodeError: a mosaic that is not known.
    """
    if camera.mosaic is None:
        return image
    if camera.mosaic not in _MOSAICS:
        raise DecodeError(f"unknown mosaic {camera.mosaic!r}", hint=f"known: {', '.join(sorted(_MOSAICS))}")
    return np.asarray(cv2.cvtColor(image, _MOSAICS[camera.mosaic]))


def upright_image(image: NDArray[Any], pattern: McpPattern, camera: CameraFormat) -> Image:
    """Checked, grey, with horizontal stripes, contiguous."""
    _check_frame(image, camera, 0)
    image = grey(image, camera)
    turned = image if pattern.axis == "y" else image.T
    if min(turned.shape) < 32:
        raise DecodeError(f"an image of {image.shape[1]} x {image.shape[0]} is smaller than a few stripes")
    return np.ascontiguousarray(turned)


# --- why not --------------------------------------------------------------------------------------------------------


def _explain(found: Found, image: Image, model: PatternModel, camera: CameraFormat) -> None:
    """Raise what `locate` found wrong; a pattern turned by 90 degrees is named."""
    if found.pitch > 0:
        _refuse_turned(image, model, camera)
    raise DecodeError(str(found.fault), hint=found.hint)


def _refuse_turned(image: Image, model: PatternModel, camera: CameraFormat) -> None:
    """Raise DecodeError if the pattern is there, codes and all, once the image is turned."""
    clock = Stages()
    found = locate(np.ascontiguousarray(image.T), model, camera, clock)
    if found.fault is None and _decide(found, model, clock).agreement.holds:
        raise DecodeError(
            "the pattern is turned by 90 degrees: its stripes run the other way",
            hint='the other "axis" in the description, or turn projector or camera',
        )


# --- which stripe is it -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Decision:
    """label (P,) int32, -1 undecided; confidence (P,); light (P,); fine positions; figures for the report."""

    label: NDArray[np.int32]
    confidence: Array
    light: Array
    fine: subpixel.Fine
    agreement: emissions.Agreement
    magnification: float
    figures: dict[str, Any]


def _decide(found: Found, model: PatternModel, clock: Stages) -> _Decision:
    peaks, chains, search, signals = found.peaks, found.chains, found.search, found.signals
    assert peaks is not None  # noqa: S101  (no fault means that the search went to its end)
    assert chains is not None  # noqa: S101
    assert search is not None  # noqa: S101
    assert signals is not None  # noqa: S101
    size = magnification.window_px(model, search.scale)
    shape = (found.reduced.shape[1], found.reduced.shape[0] * stripes.STEP)
    with clock.stage("field"):
        scale_field = magnification.fit_field(signals.light, peaks, chains, model, search, size, shape)
    with clock.stage("emissions"):
        seen = emissions.measure(signals.light, chains, scale_field, model, search.scale, size)
    sites = linking.sites_of(peaks, chains)
    here = seen.at(sites.index)
    modulation = emissions.first_modulation(here, model)
    floor = np.full(model.channels, 0.03, np.float32)
    tables = hmm.transitions(model.stripes)
    gap = hmm.gaps(sites.start, peaks.y[sites.index], peaks.height[sites.index], found.pitch, model.weakest)
    votes = np.zeros((len(gap), model.stripes), np.float32)
    posterior = votes
    for _ in range(ROUNDS):
        with clock.stage("emissions"):
            evidence, stray_log = emissions.log_likelihood(here, model, modulation, floor)
        with clock.stage("columns' model"):
            posterior, _stray = hmm.smooth_columns(evidence + votes, sites.start, gap, tables, stray_log)
        with clock.stage("votes"):
            logs = linking.floored_log(posterior, POSTERIOR_FLOOR)
            votes = linking.votes_along(logs, sites.chains, size / (4 * stripes.STEP), VOTE_GAIN)
            modulation, floor = emissions.refined_modulation(here, model, posterior, modulation)
    with clock.stage("columns' model"):
        path = hmm.best_paths(evidence + votes, sites.start, gap, tables, stray_log)
    with clock.stage("votes"):
        along = linking.path_along(logs, sites.chains, SWITCH_COST)
        sure = np.where(path >= 0, posterior[np.arange(len(path)), np.maximum(path, 0)], 0).astype(np.float32)
        decided = np.where((path == along) & (sure >= DECIDED), path, -1).astype(np.int32)
        label, confidence = linking.between_sites(decided, sure, sites, chains)
        long_enough = np.repeat(chains.lengths * stripes.STEP >= MIN_CHAIN_PX, chains.lengths)
        label[chains.order[~long_enough]] = -1
        label[linking.silhouettes(found.reduced, peaks, chains)] = -1
    with clock.stage("agreement"):
        agrees = emissions.agreement(here, evidence, model, modulation, path, (sites.start, gap))
    with clock.stage("sub-pixel"):
        fine = subpixel.refine(found.reduced, peaks, chains, label, found.pitch)
    figures = {
        "pitch_px": round(found.pitch, 3),
        "pitch_match": round(found.match, 3),
        "noise_dn": round(found.noise, 3),
        "carrier_scale": round(search.scale, 5),
        "carrier_drift": [round(search.drift_x, 3), round(search.drift_y, 3)],
        "carrier_contrast": [round(c, 2) for c in search.contrast],
        "modulation": [round(float(m), 3) for m in modulation],
        "noise_floor": [round(float(f), 4) for f in floor],
        "window_px": size,
        "agreement": {key: round(value, 4) for key, value in asdict(agrees).items()},
        "peaks": len(peaks),
        "peaks_decided": int((label >= 0).sum()),
        "thresholds": {"decided": DECIDED, "min_chain_px": MIN_CHAIN_PX, "height_share": stripes.HEIGHT_FLOOR},
    }
    return _Decision(label, confidence, np.maximum(seen.light, 0), fine, agrees, float(np.median(scale_field)), figures)


# --- maps ---------------------------------------------------------------------------------------------------------


def _maps(image: Image, found: Found, decided: _Decision, model: PatternModel, clock: Stages) -> Decoded:
    peaks, chains = found.peaks, found.chains
    assert peaks is not None  # noqa: S101
    assert chains is not None  # noqa: S101
    keep = (decided.label >= 0) & (decided.fine.whole > 0) & (peaks.clear > 0)
    label = np.where(keep, decided.label, -1).astype(np.int32)
    row = ((label + 0.5) * model.pitch - 0.5).astype(np.float32)
    counts = np.bincount(chains.column[keep], minlength=len(peaks.start) - 1)
    slope = model.pitch / found.pitch
    knots = dense.Knots(
        np.concatenate(([0], np.cumsum(counts))).astype(np.int32),
        decided.fine.y[keep],
        row[keep],
        (decided.fine.sigma[keep] * slope).astype(np.float32),
        decided.confidence[keep],
        decided.light[keep],
        peaks.height[keep],
        label[keep],
    )
    with clock.stage("dense rows"):
        maps = dense.interpolate(knots, (image.shape[0], image.shape[1]), found.pitch, model.pitch)
        marked = dense.stripe_map(decided.fine.y, label, chains, (image.shape[0], image.shape[1]))
    with clock.stage("reasons"):
        reason = _reasons(found, decided, maps.rows)
    x = chains.column[keep] * float(stripes.STEP) + 1.5
    peak_table = np.stack([x, knots.y, knots.row, knots.stripe, knots.confidence], axis=1).astype(np.float32)
    warnings = []
    if not len(peak_table):
        warnings.append("no stripe could be decided: carriers are there, but too weak or too short")
    figures = {
        **decided.figures,
        "peaks_kept": len(peak_table),
        "stages_ms": {k: round(v, 2) for k, v in clock.ms.items()},
    }
    return Decoded(
        rows=maps.rows,
        columns=None,
        sigma_rows=maps.sigma,
        sigma_columns=None,
        confidence=maps.confidence,
        albedo=maps.albedo,
        modulation=maps.modulation,
        reason=reason,
        stripes=marked,
        peaks=peak_table,
        warnings=tuple(warnings),
        details=figures,
    )


def _upside_down(decoded: Decoded) -> Decoded:
    """Turn maps back that were decoded from an image upside down."""
    peaks = decoded.peaks
    if peaks is not None:
        peaks[:, 1] = decoded.confidence.shape[0] - 1 - peaks[:, 1]
    return _with_maps(decoded, lambda array: array[::-1], details={**decoded.details, "upside_down": True})


def turned_back(decoded: Decoded) -> Decoded:
    """Rows of the turned image are columns of the image."""
    peaks = decoded.peaks
    if peaks is not None:
        peaks[:, :2] = peaks[:, 1::-1]
    upright = _with_maps(decoded, lambda array: array.T)
    return replace(upright, rows=None, sigma_rows=None, columns=upright.rows, sigma_columns=upright.sigma_rows)


def _with_maps(decoded: Decoded, change: Callable[[NDArray[Any]], NDArray[Any]], **more: Any) -> Decoded:
    """`decoded` with every map changed, contiguous."""
    names = ("rows", "sigma_rows", "confidence", "albedo", "modulation", "reason", "stripes")
    changed: dict[str, Any] = {name: np.ascontiguousarray(change(getattr(decoded, name))) for name in names}
    return replace(decoded, **changed, **more)


def _reasons(found: Found, decided: _Decision, rows: Array) -> NDArray[np.uint8]:
    """Why a pixel has no row: decided per column of four pixels by the nearest peak, (H, W) uint8."""
    peaks, chains, signals = found.peaks, found.chains, found.signals
    assert peaks is not None  # noqa: S101
    assert chains is not None  # noqa: S101
    assert signals is not None  # noqa: S101
    why = np.full(len(peaks), np.uint8(Reason.BORDER))
    why[decided.label < 0] = Reason.UNWRAP_RISK
    why[signals.clipped > 0.5] = Reason.CLIPPED
    # Without a peak: dark is shadow, bright is too little modulation.
    half_lit = np.median(peaks.valley) + 0.5 * np.median(peaks.height)
    small = np.where(half_lit < found.reduced, np.uint8(Reason.LOW_MODULATION), np.uint8(Reason.SHADOW))
    dense.spread(chains.column, peaks.y, why, int(0.6 * found.pitch), small)
    reason = np.empty(rows.shape, np.uint8)
    dense.widen_reasons(small, rows, reason)
    return reason
