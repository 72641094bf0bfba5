"""Frames that are too coarse for the pattern: the cause of a refusal that would otherwise be told by its consequences.

Stripes of two to four pixels are noise to the search for stripes; carriers of less than two pixels make codes that
contradict the description. Asked only where a frame is refused: a surface seen at a slant may look finer than it is.
Pictures without the pattern have fine lines, too: text, tiles, a photograph's grain. It must be the strongest of all.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from scanner.decode.mcp import stripes
from scanner.decode.mcp.locate import MIN_PITCH_MATCH, Array, Image
from scanner.decode.mcp.model import PatternModel
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat

FINEST_CARRIER_PX = 2.0
"""A shorter period is not seen but folded back to a longer one (Shannon 1949)."""

FINE_PX = 2 * stripes.MIN_PITCH_PX
"""Distance of lines up to which they may count as noise: second differences, by which noise is measured, vanish on
flanks of two pixels and more."""

STANDS_OUT = 2.0
"""Ratio to the median of a spectrum's fine part, and of what lies about it, above which a line is neither noise nor the
slope of a picture. A mean of 64 columns' amplitudes, which are Rayleigh distributed, scatters by .07 of it: the largest
of some hundred stays below 1.3, of eight columns' below 1.8."""

NEAR, ABOUT = 1.2, 1.7
"""What lies about a line: further off than the first factor, which keystone and tilt take, and within the second"""

MOST_BELOW = 2.3
"""Coarser lines' amplitude over the line's own, up to which it is not theirs. Stripes bright and dim in turn have 1.6
times as much at two of them, and scenes before the published pattern no more; harmonics of text and of squares have
four times as much below them, photographs three and more."""

LEAST_CONTRAST = 0.01
"""Share of the camera's range below which an image shows nothing (as in `locate`)."""

HINT = "take frames of more pixels, move the camera nearer, or project fewer bits or lower carriers"


def refuse_too_fine(image: Image, model: PatternModel, camera: CameraFormat, said: str, *, structure: bool) -> None:
    """Name the cause where a frame was refused that is too coarse for the pattern.

    Args:
        image: (H, W), stripes horizontal.
        model: the pattern's tables.
        camera: the frame's format.
        said: why it was refused; goes with the cause.
        structure: stripes were found. Those too fine beat with the pixels, and the beat looks like stripes.

    Raises:
        DecodeError: stripes, or carriers, are too fine for the camera.
    """
    reduced = stripes.reduce_columns(image)
    if float(np.ptp(reduced[::4])) < LEAST_CONTRAST * camera.max_value:
        return
    fine, cause = fine_stripes(reduced, model), None
    if fine is not None and fine < stripes.MIN_PITCH_PX:
        cause = f"stripes are {fine:.1f} px apart, too fine for this camera: {stripes.MIN_PITCH_PX:g} px are needed"
    elif structure and (words := if_whole(image, model)) is not None:
        cause = words
    elif fine is not None:
        cause = _carriers(fine, model)
    elif structure:
        pitch, match = stripes.estimate_pitch(reduced, model)[0]
        cause = _carriers(pitch, model) if match >= MIN_PITCH_MATCH else None
    if cause is not None:
        raise DecodeError(f"{cause} ({said})", hint=HINT)


def if_whole(image: Image, model: PatternModel) -> str | None:
    """What to say of stripes that are finer than can be decoded even if the pattern fills the picture."""
    pitch = image.shape[0] / model.stripes
    if pitch >= stripes.MIN_PITCH_PX:
        return None
    return (
        f"stripes may be too fine for this camera: {model.stripes} on {image.shape[0]} px are {pitch:.1f} px high, "
        f"{stripes.MIN_PITCH_PX:g} are needed"
    )


def fine_stripes(reduced: Array, model: PatternModel) -> float | None:
    """The pitch of stripes so fine that the search for them takes them for noise, px; None where there are none.

    Args:
        reduced: (B, H) float32, columns averaged by fours.
        model: the pattern's tables.
    """
    amplitude, frequency, best = _strongest_line(reduced[:: max(1, len(reduced) // 64)])
    fine, line = frequency > 1 / FINE_PX, frequency[best]
    if not fine[best] or amplitude[best] < STANDS_OUT * float(np.median(amplitude[fine])):
        return None
    away = np.abs(np.log(np.maximum(frequency, 1e-9) / line))
    about = (away > np.log(NEAR)) & (away < np.log(ABOUT))
    coarser = (frequency * reduced.shape[1] >= stripes.MIN_STRIPES) & (frequency < line / NEAR)
    if about.any() and amplitude[best] < STANDS_OUT * float(np.median(amplitude[about])):
        return None
    if coarser.any() and amplitude[best] * MOST_BELOW < float(amplitude[coarser].max()):
        return None
    # Stripes that are bright and dim in turn have their strongest line at two of them.
    _, own, of_pattern = _strongest_line(np.tile(model.column, 4)[None, :])
    return float(16 * own[of_pattern] / line)


def _strongest_line(columns: Array) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Mean amplitudes of the columns' spectrum, their frequencies, and where amplitude times frequency is largest.

    Times frequency: scenes fall off with 1 / f, and harmonics of a triangle with 1 / f^2.
    """
    size = columns.shape[1]
    lines = (columns - columns.mean(axis=1, keepdims=True)) * np.hanning(size)
    amplitude = np.abs(rfft(lines, 2 * size, axis=1)).mean(axis=0)
    frequency = np.arange(len(amplitude)) / (2 * size)
    level = np.where(frequency * size >= stripes.MIN_STRIPES, amplitude * frequency, 0)
    return amplitude, frequency, int(np.argmax(level))


def _carriers(pitch: float, model: PatternModel) -> str | None:
    """What to say of carriers that stripes of this height have in less than two pixels."""
    period = pitch / model.pitch / float(model.carriers.max())
    if period >= FINEST_CARRIER_PX:
        return None
    return (
        f"carriers are too fine for this camera: on stripes {pitch:.1f} px high the finest has a period of "
        f"{period:.1f} px, more than {FINEST_CARRIER_PX:g} are needed"
    )
