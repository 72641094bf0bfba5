"""What a pattern looks like to the decoder: one row of figures for each stripe.

No image is touched here. The tables follow from the formulas of formats.md (Casey 2011, eq. 3.1-3.6), so one decoder
serves the published pattern and any other description.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scanner.patterns import McpPattern, ProjectorSize

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PatternModel:
    """Tables over stripes (S) and channels (N).

    ratio: (S, N) float32, amplitude of each carrier over the stripe's mean light; 0 where switched off.
    level: (S,) float32, the stripe's mean light; 0 for a stripe without light.
    carriers: (N,) float32, cycles per projector pixel.
    pitch: height of a stripe, projector px.
    even: the image shows it without print and shading, which a second frame has taken out.
    """

    ratio: Array
    level: Array
    carriers: Array
    pitch: float
    profile: str
    even: bool = False

    @classmethod
    def of(cls, pattern: McpPattern, projector: ProjectorSize, *, even: bool = False) -> PatternModel:
        """The tables of `pattern` as shown by `projector`."""
        count, channels = pattern.stripe_count, pattern.bits
        ratio = np.zeros((count, channels), np.float32)
        level = np.zeros(count, np.float32)
        for stripe in range(count):
            code = pattern.code_of(stripe)
            on = np.array([code is not None and bool(code >> i & 1) for i in range(channels)])
            if pattern.levels == "equal":
                level[stripe], amplitude = 0.5, 1 / (2 * channels)
            elif code is None:
                level[stripe], amplitude = pattern.unmodulated, 0.0
            else:
                level[stripe], amplitude = on.sum() / (2 * channels), 1 / (2 * channels)
            if level[stripe] > 0:
                ratio[stripe] = on * amplitude / level[stripe]
        across = projector.along("x" if pattern.axis == "y" else "y")
        carriers = np.asarray(pattern.carriers, np.float32) / np.float32(across)
        return cls(ratio, level, carriers, pattern.pitch_px(projector), pattern.profile, even)

    @property
    def stripes(self) -> int:
        """Number of stripes, both kinds."""
        return len(self.level)

    @property
    def channels(self) -> int:
        """Number of carriers."""
        return len(self.carriers)

    @cached_property
    def weakest(self) -> float:
        """Mean light of the dimmest stripe that has any, over that of the brightest."""
        return float(self.level[self.level > 0].min() / self.level.max())

    @cached_property
    def usual(self) -> list[tuple[float, float]]:
        """Of each channel the quantile of its peaks by which strong ones are told, 0 if it carries nothing, and the
        amplitude of a stripe at it.
        """
        found = []
        for own in self.ratio[self.level > 0].T:
            share = 1 - float((own > 0).mean()) / 2
            found.append((share, float(np.quantile(own, share, method="nearest"))) if share < 1 else (0.0, 0.0))
        return found

    @cached_property
    def amplitudes(self) -> list[NDArray[np.float32]]:
        """Of each channel the different ratios, from the least: 2 ("equal") or up to N + 1 ("composite")."""
        return [np.unique(own) for own in self.ratio.T]

    @cached_property
    def shows(self) -> Array:
        """(A, S) float32, 1 where a stripe has that of the `amplitudes`, channel after channel, else 0."""
        each = [own == value for own, values in zip(self.ratio.T, self.amplitudes, strict=True) for value in values]
        return np.asarray(each, np.float32)

    @cached_property
    def words(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Different code words, by the channels that are on; and which of them each stripe (S,) has."""
        return np.unique((self.ratio > 0) @ (1 << np.arange(self.channels)), return_inverse=True)

    @cached_property
    def separation(self) -> float:
        """Smallest distance between two carriers, and from the lowest to DC, cycles per projector pixel."""
        ordered = np.sort(np.concatenate(([0.0], self.carriers)))
        return float(np.diff(ordered).min())

    @cached_property
    def column(self) -> Array:
        """(L,) float32: light along the phase direction, averaged over the carriers; 16 samples to a pitch."""
        t = (np.arange(16) + 0.5) / 16
        profile = 1 - np.abs(2 * t - 1) if self.profile == "triangle" else (1 - np.cos(2 * np.pi * t)) / 2
        return (self.level[:, None] * profile[None, :]).ravel().astype(np.float32)
