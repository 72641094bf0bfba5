"""Least-squares fits of fringe sets on thumbnails: what the witnesses of content share.

Plain NumPy over some 20,000 samples; the decoder's own fit, made for every pixel of a scan, is `scanner.decode.pmp`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.patterns import PmpPattern
from scanner.patterns.pmp import FringeSet
from scanner.sequencer.findings import NOISE_SIGMAS, Array, Scene

MIN_PIXELS = 150
"""Lit pixels of the thumbnail, fewer than which prove nothing."""


PHASE_BINS = 24
"""Bins of phase in which frames are compared: a tenth harmonic is still seen."""

MIN_IN_BIN = 12
"""Samples in each, so that noise can be told from disorder."""


@dataclass(frozen=True, eq=False)
class Fit:
    """One set's least-squares fit I_n = A + B cos(theta + alpha_n) over all samples."""

    fringe_set: FringeSet
    positions: tuple[int, ...]
    """of the frames that are here"""
    alpha: NDArray[np.float64]
    frames: Array
    """(N, P) grey levels"""
    mean: Array
    modulation: Array
    cycles: Array
    """(P,) theta / 2 pi"""

    def model(self, where: NDArray[np.intp]) -> Array:
        """(N, p) what the frames should show at some samples."""
        angles = 2 * np.pi * self.cycles[where] + self.alpha.astype(np.float32)[:, None]
        return np.asarray(self.mean[where] + self.modulation[where] * np.cos(angles), dtype=np.float32)


def fit_set(scene: Scene, pattern: PmpPattern, fringe_set: FringeSet) -> Fit | None:
    """Fit the frames of a set that are here; None if fewer than three are."""
    fringes = scene.sequence.fringes[fringe_set.first : fringe_set.first + fringe_set.shifts]
    here = [n for n, p in enumerate(fringes) if p in scene.frames]
    if len(here) < 3:
        return None
    alpha = pattern.sign * 2 * np.pi * np.asarray(here) / fringe_set.shifts + pattern.offset
    frames = np.stack([scene.frames[fringes[n]] for n in here])
    mean, cosine, sine = solve(design_matrix(alpha), frames)
    cycles = np.arctan2(sine, cosine) / np.float32(2 * np.pi)
    return Fit(fringe_set, tuple(fringes[n] for n in here), alpha, frames, mean, np.hypot(cosine, sine), cycles)


def design_matrix(alpha: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) rows [1, cos alpha, -sin alpha]: I = [A, B cos theta, B sin theta] . row."""
    return np.stack([np.ones_like(alpha), np.cos(alpha), -np.sin(alpha)], axis=1)


def solve(design: NDArray[np.float64], frames: Array) -> Array:
    """(3, P) A, B cos theta, B sin theta by least squares."""
    return np.asarray(np.linalg.pinv(design).astype(np.float32) @ frames)


def clipped_pixels(scene: Scene) -> NDArray[np.bool_]:
    """(P,) samples that saturate in any fringe frame that is there."""
    fringes = [scene.frames[p] for p in scene.sequence.fringes if p in scene.frames]
    return np.any([frame >= scene.max_value for frame in fringes], axis=0) if fringes else np.zeros_like(scene.lit)


def bright_pixels(scene: Scene, fit: Fit, clipped: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels with a modulation well above its noise, and not clipped."""
    b = fit.modulation
    sigma = scene.noise * float(np.sqrt(2 / len(fit.positions)))
    return scene.lit & ~clipped & (b > NOISE_SIGMAS * sigma) & (b > 0.25 * float(np.quantile(b, 0.99)))


def mean_vector(fit: Fit, use: NDArray[np.bool_] | NDArray[np.intp]) -> float:
    """Length of the mean phase vector: 1 where the scene shows one phase only, 0 where it shows all alike."""
    angles = np.float32(2 * np.pi) * fit.cycles[use]
    return float(np.hypot(np.cos(angles).mean(), np.sin(angles).mean()))


def left_over(design: NDArray[np.float64], frames: Array, b: Array) -> Array:
    """(N, P) residual of frames over B."""
    left = frames - design.astype(np.float32) @ solve(design, frames)
    left /= b
    return left


def rms(left: Array) -> float:
    """Of a residual over B: over frames, median over pixels."""
    return float(np.sqrt(np.median((left**2).sum(axis=0)) / max(len(left) - 3, 1)))


def disorder(fit: Fit, use: NDArray[np.bool_], left: Array) -> tuple[float, tuple[int, ...]] | None:
    """What of the residual no response explains, rms over B; and the positions that hold most of it.

    A projector's and camera's response bends all frames of a set alike: what frame n leaves at a pixel depends on
    theta + alpha_n alone, and on the same function of it for all n. Frames are compared bin by bin of that phase; the
    noise of the bins' means is taken off.

    Args:
        use: pixels that are asked. left: the residual there (`left_over`).

    Returns:
        None where the scene shows some phases too rarely, or too few frames leave a residual.
    """
    count = len(fit.positions)
    if count < 4 or count != fit.fringe_set.shifts:
        return None
    turns = fit.cycles[use][None, :] + (fit.alpha / (2 * np.pi)).astype(np.float32)[:, None]
    turns -= np.floor(turns)  # a remainder by division takes a hundred times as long
    index = (turns * PHASE_BINS).astype(np.intp)
    index[index == PHASE_BINS] = 0
    members = np.stack([np.bincount(row, minlength=PHASE_BINS) for row in index])
    if members.min() < MIN_IN_BIN:
        return None
    pairs = list(zip(index, left, strict=True))
    means = np.stack([np.bincount(i, weights=row, minlength=PHASE_BINS) for i, row in pairs]) / members
    squares = np.stack([np.bincount(i, weights=row * row, minlength=PHASE_BINS) for i, row in pairs]) / members
    noise = ((squares - means**2) / members).mean(axis=1)
    power = np.maximum(((means - means.mean(axis=0)) ** 2).mean(axis=1) - 2 * noise, 0)
    value = float(np.sqrt(power.sum() / (count - 3)))
    # Four or five frames leave one or two degrees of freedom: the residual spreads over all of them.
    most = power > 0.5 * power.max() if count > 5 else np.full(count, True)
    return value, tuple(p for p, guilty in zip(fit.positions, most, strict=True) if guilty)
