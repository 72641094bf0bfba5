"""First-generation Composite Pattern: one image to projector rows, by classic demodulation (Guan et al. 2003, sec. 2).

    carriers      the projected ones, found together at the one scale at which all stand out
    channels      band-pass, envelope (shift to zero and low-pass, without the carrier's phase)
    phase         of the N shifts, as in PMP; one period over the projector

A value at every lit pixel, averaged over the band-pass; no better than three hundredths of the projector: blur takes
more of a high carrier than of a low one, which bends the phase (Casey 2011, sec. 5.6, tells 72 mm of depth).
The stated sigmas are those of the random error alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.special import ndtr

from scanner.decode import Decoded, Reason
from scanner.decode.frames import FrameCheck
from scanner.decode.mosaic import grey as one_channel
from scanner.decode.noise import default_noise
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, CompositePattern, PatternSequence, ProjectorSize
from scanner.patterns.pmp import AMPLITUDE, MEAN

Map = NDArray[np.float32]

LEAST_CONTRAST = 0.01
"""Share of the camera's range below which an image holds no pattern."""

SMALLEST_PX = 64
"""Shorter sides hold too few periods of a carrier."""

BAND = 0.25
"""Sigma of a channel's Gaussian band-pass, in carrier separations: it lets 3 parts in 10,000 of its neighbour's middle
through, and a carrier that keystone moves by 3 % (sec. 4.2 of the dissertation's rig) keeps nine tenths and more."""

LOWEST_CYCLES = 6.0
"""Of the lowest carrier over the image: fewer periods have no band of their own."""

HIGHEST = 0.4
"""Of the highest carrier, cycles per camera pixel: beyond, a camera's pixels leave next to nothing of it."""

COARSE_PX = 6.0
"""Least period of the finest carrier that leaves room for a scene's own detail below the lowest: the reference rig has
7 px and keeps every scene's carriers; with 4 px a plain board's are found, and a textured bust's drown. Only words hang
on it."""

BAND_CONTRAST = 2.5
"""Least ratio of the weakest carrier's band to the median between bands, in power: noise and other patterns stay below
1.7, the reference scenes lie above 9, but for a strong texture of the carriers' own periods, which is refused."""

OTHER_CONTRAST = 8.0
OTHER_SHARE = 0.15
"""A wave that is none of the carriers is one that the description left out, if its power is that much above both its
sides and that share of the weakest carrier's. Overtones of a wrong gamma stay below a twentieth."""

LEAST_SHARE = 0.05
"""Of the image's 99th percentile of modulation: what lies below is a band-pass's skirt, or shadow."""

LEAST_SIGMAS = 7.0
"""Modulation over its own noise, as for PMP."""

MOST_RESIDUAL = 0.35
"""Residual of the sinusoid's fit over its amplitude, rms: beyond, the channels are no shifts of one fringe."""

CLIPPED_SHARE = 0.05
"""Of the pixels under a band-pass: clipped ones feed every channel."""

SYSTEMATIC_CYCLES = 0.03
"""Phase error that no averaging removes, rms: unequal channels and leakage, on the reference scenes .028 to .040. It
decides how near to the pattern's ends first and last rows cannot be told apart."""

EDGE_SIGMAS = 2.0

MOST_CONTRADICTING = 0.7
"""Of the modulated pixels: if more of them have channels that are no shifts of one fringe, it is another pattern."""


class CompositeDecoder:
    """Takes the one frame of a composite pattern (and its black one, if any) and decodes it.

    Raises:
        DecodeError: the sequence is not a composite pattern.
    """

    def __init__(self, sequence: PatternSequence, camera: CameraFormat) -> None:
        if not isinstance(sequence.pattern, CompositePattern):
            raise DecodeError(f"the composite pattern's decoder was given method {sequence.pattern.method!r}")
        self._sequence = sequence
        self._pattern = sequence.pattern
        self._camera = camera
        self._check = FrameCheck(sequence, camera)
        self._image: NDArray[Any] | None = None
        self._black: NDArray[Any] | None = None

    def add(self, position: int, frame: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
        """Take the frame at `position`; see `scanner.decode.Decoder`."""
        self._check.take(position, frame)
        if position == self._sequence.fringes[0]:
            self._image = frame.copy()
        elif position == self._sequence.black:
            self._black = frame.copy()

    def finish(self) -> Decoded:
        """The maps; see `scanner.decode.Decoder`."""
        if self._image is None:
            raise DecodeError(
                "the composite pattern's frame is missing", hint=f"it is frame {self._sequence.fringes[0]}"
            )
        image = self._image if self._black is None else cv2.subtract(self._image, self._black)
        return decode_image(image, self._pattern, self._sequence.projector, self._camera)


def decode_image(
    image: NDArray[Any],
    pattern: CompositePattern,
    projector: ProjectorSize,
    camera: CameraFormat,
) -> Decoded:
    """Decode one image.

    Args:
        image: (H, W) uint8 or uint16, linear camera response, as captured.
        pattern: what was projected.
        projector: size of the projector's image.
        camera: format of `image`.

    Raises:
        DecodeError: no pattern, other carriers than described, or a pattern turned by 90 degrees.
    """
    pattern.validate(projector)
    grey = _upright(image, pattern, camera)
    across = projector.along("x" if pattern.axis == "y" else "y")
    _refuse_flat(grey, camera)
    search = find_carriers(grey, np.asarray(pattern.carriers))
    _refuse_carriers(search, grey, pattern)
    # The separation as captured: the carriers found lie in the projected ones' proportions.
    sigma = BAND * pattern.separation * search.scale
    waves = envelopes(grey, search.frequencies, sigma)
    maps = _maps(grey, waves, sigma, pattern, projector, camera)
    period = [round(float(1 / f), 2) for f in search.frequencies]
    details = {
        "method": "cp",
        "carriers": [round(float(f) * grey.shape[1], 2) for f in search.frequencies],
        "carrier_periods_px": period,
        "carrier_scale": round(search.scale * across, 5),
        "carrier_contrast": round(search.contrast, 2),
        "band_sigma_px": round(1 / (2 * np.pi * sigma), 2),
        "counts": {r.name.lower(): int(n) for r in Reason if (n := np.count_nonzero(maps["reason"] == np.uint8(r)))},
    }
    contradicting = np.count_nonzero(maps["reason"] == np.uint8(Reason.UNWRAP_RISK))
    modulated = np.isin(maps["reason"], (Reason.VALUE, Reason.UNWRAP_RISK, Reason.BORDER)).sum()
    if contradicting > MOST_CONTRADICTING * modulated:
        raise DecodeError(
            f"carriers are there, but their channels are no shifts of one fringe ({contradicting / modulated:.0%} of "
            "the pixels contradict)",
            hint="check the order of the carriers in the description, the focus, and the projector's gamma",
        )
    if not np.isfinite(maps["rows"]).any():
        raise DecodeError(
            "carriers are there, but no pixel has modulation enough", hint="raise the exposure, and check the focus"
        )
    turned = maps if pattern.axis == "y" else {k: np.ascontiguousarray(v.T) for k, v in maps.items()}
    rows, sigma_rows = turned.pop("rows"), turned.pop("sigma")
    along_y = pattern.axis == "y"
    return Decoded(
        rows=rows if along_y else None,
        columns=None if along_y else rows,
        sigma_rows=sigma_rows if along_y else None,
        sigma_columns=None if along_y else sigma_rows,
        **turned,
        warnings=(CAUTION,),
        details=details,
    )


CAUTION = (
    "first-generation composite pattern: depths are biased by centimetres (72 mm published, Casey 2011, table 5.6), "
    "the stated sigma is its random part only, and confidence (near 1 everywhere) says no more than that the pattern's "
    "two ends were not taken for one another"
)


# --- carriers -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Carriers:
    """frequencies: (N,) cycles per camera px, in the pattern's order. scale: of those over the projected ones.

    contrast: power of the weakest carrier's band over the median between bands.
    others: further waves that stand out like carriers, cycles per projector field.
    """

    frequencies: NDArray[np.float64]
    scale: float
    contrast: float
    others: tuple[float, ...] = ()


def find_carriers(grey: Map, projected: NDArray[np.float64]) -> Carriers:
    """The carriers as captured: the one scale at which all of them stand out, then each at its own maximum.

    Args:
        grey: (H, W), carriers along x.
        projected: (N,) cycles per projector field, any order.
    """
    width = grey.shape[1]
    window = np.hanning(width).astype(np.float32)
    lines = fft.rfft((grey - grey.mean(axis=1, keepdims=True)) * window, axis=1)
    power = (lines.real**2 + lines.imag**2).sum(axis=0, dtype=np.float64)
    power = np.convolve(power, [0.25, 0.5, 0.25], mode="same")
    lowest, highest = float(projected.min()), float(projected.max())
    scales = np.geomspace(LOWEST_CYCLES / lowest, max(HIGHEST * width / highest, 1.01 * LOWEST_CYCLES / lowest), 4000)
    bins = np.arange(len(power))
    at = np.interp(scales[:, None] * projected, bins, power)
    ordered = np.sort(np.concatenate(([0.0], projected)))
    between = np.interp(scales[:, None] * (ordered[1:] + ordered[:-1]) / 2, bins, power)
    # Power falls by decades from DC on: each carrier is held against what lies half way to its lower neighbour.
    tiny = 1e-12 * float(power.max()) + 1e-30
    rank = np.argsort(np.argsort(projected))
    score = (np.log(at + tiny) - np.log(between[:, rank] + tiny)).min(axis=1) + np.log(at + tiny).mean(axis=1) * 0.5
    scale = float(scales[np.argmax(score)])
    half = 0.25 * float(np.diff(ordered).min()) * scale
    found, strength = [], []
    for f in projected * scale:
        near = np.arange(max(1, int(f - half)), min(len(power) - 1, int(f + half) + 2))
        k = int(near[np.argmax(power[near])])
        a, b, c = np.log(power[k - 1 : k + 2] + tiny)
        curve = a - 2 * b + c
        found.append(k + (0.5 * (a - c) / curve if curve < 0 else 0.0))
        strength.append(power[k])
    low, high = int(0.5 * scale * lowest), int(scale * (highest + 0.5 * lowest)) + 1
    floor = float(np.median(power[low:high]))
    contrast = float(min(strength)) / floor if floor > 0 else 0.0
    frequencies = np.array(found) / width
    captured = float((frequencies / projected).mean())
    others = _other_waves(power, np.array(found), min(strength))
    return Carriers(frequencies, captured, contrast, tuple(float(k / width / captured) for k in others))


def _other_waves(power: NDArray[np.float64], carriers: NDArray[np.float64], weakest: float) -> NDArray[np.intp]:
    """Bins of waves that stand out between, below and above the carriers (bins), by both their sides."""
    separation = float(np.diff(np.sort(np.concatenate(([0.0], carriers)))).min())
    near, far = int(0.15 * separation), int(0.4 * separation) + 1
    bins = np.arange(max(far, int(0.3 * separation)), len(power) - far)
    if far - near < 2 or not bins.size:
        return np.zeros(0, np.intp)
    sides = np.median(np.lib.stride_tricks.sliding_window_view(power, far - near), axis=1)
    beside = np.maximum(sides[bins - far], sides[bins + near])
    apart = np.abs(bins[:, None] - carriers).min(axis=1) > 0.3 * separation
    crest = (power[bins] >= power[bins - 1]) & (power[bins] >= power[bins + 1])
    stands_out = (power[bins] > OTHER_CONTRAST * beside) & (power[bins] > OTHER_SHARE * weakest)
    found: NDArray[np.intp] = bins[apart & crest & stands_out]
    return found


def envelopes(grey: Map, frequencies: NDArray[np.float64], sigma: float) -> Map:
    """Amplitude of each carrier around every pixel (Guan et al. 2003, eq. 7-9), (N, H, W) float32, grey levels.

    Band-pass and shift to zero in one: the one-sided band's magnitude. Low-passed along y to the same width.

    Args:
        grey: (H, W), carriers along x.
        frequencies: (N,) cycles per px.
        sigma: of the Gaussian band-pass, cycles per px.
    """
    height, width = grey.shape
    reach = 1 / (2 * np.pi * sigma)
    pad = min(int(3 * reach), width - 1)
    length = fft.next_fast_len(width + 2 * pad)
    # Reflected, a carrier keeps its amplitude over the border, if not its phase.
    padded = cv2.copyMakeBorder(grey - grey.mean(), 0, 0, pad, length - width - pad, cv2.BORDER_REFLECT)
    spectrum = fft.rfft(np.asarray(padded, np.float32), axis=1)
    axis = np.arange(spectrum.shape[1]) / length
    out = np.empty((len(frequencies), height, width), np.float32)
    for n, f in enumerate(frequencies):
        band = np.exp(-((axis - f) ** 2) / (2 * sigma**2)).astype(np.float32)
        one_sided = np.zeros((height, length), np.complex64)
        one_sided[:, : len(axis)] = spectrum * band
        envelope = 2 * np.abs(fft.ifft(one_sided, axis=1)[:, pad : pad + width])
        out[n] = cv2.GaussianBlur(envelope, (1, 2 * int(3 * reach) + 1), reach, borderType=cv2.BORDER_REFLECT)
    return out


# --- refusals -----------------------------------------------------------------------------------------------------


def _upright(image: NDArray[Any], pattern: CompositePattern, camera: CameraFormat) -> Map:
    """The image with its carriers along x, (H, W) float32."""
    if image.shape != camera.shape or image.dtype != camera.dtype:
        raise DecodeError(f"the image has shape {image.shape} and dtype {image.dtype}, not the camera's format")
    image = one_channel(image, camera)
    if min(image.shape) < SMALLEST_PX:
        raise DecodeError(f"an image of {image.shape[1]} x {image.shape[0]} holds too few periods of the carriers")
    turned = image if pattern.axis == "y" else image.T
    return np.ascontiguousarray(turned, dtype=np.float32)


def _refuse_flat(grey: Map, camera: CameraFormat) -> None:
    low, high = (float(v) for v in np.percentile(grey[::4, ::4], (1, 99)))
    if high - low < LEAST_CONTRAST * camera.max_value:
        raise DecodeError(
            f"no pattern: the image is uniform (grey levels {low:.0f} to {high:.0f})",
            hint="check that the projector shows the pattern, its focus, and the exposure",
        )


def _refuse_carriers(search: Carriers, grey: Map, pattern: CompositePattern) -> None:
    """Raise DecodeError unless all carriers stand out in their proportions, and no others do; a turned pattern is
    named."""
    if _match(search, pattern):
        if search.others:
            raise DecodeError(
                f"carriers stand out that the description does not have: {', '.join(f'{f:.0f}' for f in search.others)}"
                " cycles per field",
                hint='compare the description\'s "carriers" with those projected',
            )
        return
    if _match(find_carriers(np.ascontiguousarray(grey.T), np.asarray(pattern.carriers)), pattern):
        raise DecodeError(
            "the pattern is turned by 90 degrees: its carriers run the other way",
            hint='the other "axis" in the description, or turn projector or camera',
        )
    wanted = " : ".join(f"{f:g}" for f in pattern.carriers)
    said = f"no carriers stand out in the proportions {wanted} (contrast {search.contrast:.1f})"
    finest = grey.shape[1] / max(pattern.carriers)
    if finest < COARSE_PX:
        raise DecodeError(
            f"{said}; this camera is coarse for them: {finest:.1f} px for a period of the finest, where the pattern "
            "fills its picture",
            hint="take a camera of more pixels, or pmp or gray, which need fewer; a plain surface, in focus, may do",
        )
    raise DecodeError(said, hint="check carriers and axis of the description, focus, and what is projected")


def _match(search: Carriers, pattern: CompositePattern) -> bool:
    """Whether the carriers stand out, and lie where one scale puts them, to a quarter of their separation."""
    off = np.abs(search.frequencies / search.scale - np.asarray(pattern.carriers)).max()
    return search.contrast >= BAND_CONTRAST and float(off) <= 0.25 * pattern.separation


# --- maps ---------------------------------------------------------------------------------------------------------


def _maps(
    grey: Map, waves: Map, sigma: float, pattern: CompositePattern, projector: ProjectorSize, camera: CameraFormat
) -> dict[str, Any]:
    """All maps on the upright grid."""
    along, count = projector.along(pattern.axis), pattern.shifts
    reach = 1 / (2 * np.pi * sigma)
    angle = 2 * np.pi * np.arange(count) / count
    cosine, sine = (np.tensordot(f(angle), waves, 1) * (2 / count) for f in (np.cos, np.sin))
    amplitude = np.hypot(cosine, sine)
    cycles = (np.arctan2(sine, cosine) / (2 * np.pi)) % 1.0
    mean = waves.mean(axis=0)
    fitted = mean + cosine * np.cos(angle)[:, None, None] + sine * np.sin(angle)[:, None, None]
    residual = np.sqrt(np.mean((waves - fitted) ** 2, axis=0))
    window = (2 * int(reach) + 1, 2 * int(reach) + 1)
    albedo: Map = np.asarray(cv2.GaussianBlur(grey, (0, 0), reach, borderType=cv2.BORDER_REFLECT), np.float32)
    clipped = cv2.blur((grey >= camera.max_value).astype(np.float32), window, borderType=cv2.BORDER_REFLECT)
    # One quadrature of a Gaussian band of both signs passes 2 sqrt(pi) sigma of white noise; the blur along y, of a
    # spatial sigma of `reach`, 1 / (2 sqrt(pi) reach) of that.
    passed = sigma / reach
    noise = default_noise(camera.max_value).variance(albedo) * np.float32(passed)
    spread = np.sqrt(2 / count * noise) / np.maximum(amplitude, 1e-6) / (2 * np.pi)
    total = np.hypot(spread, SYSTEMATIC_CYCLES)
    ends = np.minimum(cycles, 1 - cycles)
    least = LEAST_SHARE * float(np.percentile(amplitude[::4, ::4], 99))
    reason = np.zeros(grey.shape, np.uint8)
    reason[ends < EDGE_SIGMAS * total] = Reason.BORDER
    reason[residual > MOST_RESIDUAL * amplitude] = Reason.UNWRAP_RISK
    # A fringe swings by nearly its own mean; half of that is another surface's light, or a channel lost.
    reason[amplitude < 0.5 * AMPLITUDE / MEAN * mean] = Reason.UNWRAP_RISK
    reason[amplitude < LEAST_SIGMAS * np.sqrt(noise)] = Reason.LOW_MODULATION
    reason[amplitude < least] = Reason.SHADOW
    reason[clipped > CLIPPED_SHARE] = Reason.CLIPPED
    undecided = reason != Reason.VALUE
    rows = (cycles * along - 0.5).astype(np.float32)
    sigma_rows = (spread * along).astype(np.float32)
    confidence = ndtr(ends / total).astype(np.float32)
    rows[undecided] = sigma_rows[undecided] = np.nan
    confidence[undecided] = 0
    return {
        "rows": rows,
        "sigma": sigma_rows,
        "confidence": confidence,
        "albedo": albedo,
        "modulation": amplitude.astype(np.float32),
        "reason": reason,
    }
