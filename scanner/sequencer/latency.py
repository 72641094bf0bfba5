"""Measures a projector's latency and settling by the camera: from a flip's stamp to the change of light.

A flip from black to white is sampled by short exposures at varied delays. An exposure that is still dark everywhere
was over before the light began to change; one that is fully lit everywhere began after it had settled. How the light
changed in between does not matter, nor does it whether the picture changes at once or sweeps down row by row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.clock import Clock
from scanner.devices import Camera, CameraSettings, Interval, Projector, ProjectorKind, TriggerMode
from scanner.errors import ConfigError, SyncError
from scanner.sequencer.shots import BLACK, WHITE, Shot, Shots

LONGEST_REFRESHES = 5
"""The slowest displays known (frame interpolation off) lag by four refreshes."""

NEVER_NS = 1_000_000_000
"""A picture that does not shine after a second never will: the longest that light is waited for to say that it came,
too late."""

STEADY = 0.04
"""Share of the contrast within which light counts as dark or as full, beyond noise."""

BLOCKS = 8
"""The view is judged in BLOCKS x BLOCKS parts, so that a sweep down the rows is seen."""

MIN_CONTRAST_SIGMAS = 20.0
"""Contrast of a block's mean over its noise that makes 4 % of it visible."""

LATE_CONTRAST = 0.04
"""Of the camera's range: ten times the read noise of any camera, and a block's mean has less."""

COARSE, FINE = 1, 10
"""Flips sampled all through to find the change, and flips sampled at its two ends."""

EARLIER_NS = 1_000_000
"""An exposure that shall be over before a moment is asked for this much earlier: a host that wakes late is late."""


@dataclass(frozen=True)
class _Sample:
    """One exposure after a black-to-white flip. Times from the flip, with the stamps' bounds taken off."""

    start_ns: int
    end_ns: int
    dark: bool
    full: bool
    bound_ns: int
    """taken off at both ends"""
    rolling_ns: int
    """between the starts of the first row and the last"""


def measure(
    projector: Projector,
    camera: Camera,
    clock: Clock,
    *,
    settings: CameraSettings | None = None,
    trigger_mode: TriggerMode | None = None,
) -> tuple[Interval, Interval]:
    """Measure (latency, settle) of a rig; the images in the projector are replaced, the camera is left stopped.

    latency: from the flip's stamp to the first change anywhere. settle: from then until all is steady.

    Raises:
        ConfigError: the projector cannot flip.
        SyncError: black and white cannot be told apart.
        LateLight: the light changes later than any display's.
        DeviceError: no frame came.
    """
    if projector.capabilities.kind is not ProjectorKind.FRAMEBUFFER:
        raise ConfigError("only a display that the host flips has a latency to measure", device=projector.name)
    refresh = projector.capabilities.refresh_ns
    longest = LONGEST_REFRESHES * refresh
    with Shots(projector, camera, clock, settings=settings, trigger_mode=trigger_mode, light_delay_ns=longest) as shots:
        scale = _Scale(shots, _exposure(shots, refresh))
        samples: list[_Sample] = []
        for i in range(COARSE):
            samples += _burst(shots, scale, i * shots.exposure_ns // 2, longest)
        if not any(sample.full for sample in samples):
            raise _late(projector, longest)
        shots.light_delay_ns = min(longest, _end(samples)[1] + refresh)
        for i in range(FINE):
            samples += _burst(shots, scale, _where_next(samples, begin=i % 2 == 0), shots.light_delay_ns)
        shots.show(BLACK)
    return _intervals(samples, scale.tolerance)


class LateLight(SyncError):
    """Light follows a flip, but later than any display's."""

    def data(self) -> dict[str, Any]:
        """A `SyncError`'s, for those who know no other."""
        return {**super().data(), "class": SyncError.__name__}


@dataclass(frozen=True)
class Disagreement:
    """A latency that is given and not what the camera sees."""

    latency: Interval
    settle: Interval
    """measured"""
    off_ns: int
    """the given one is too long (positive) or too short by this at least"""


def disagreement(
    projector: Projector,
    camera: Camera,
    clock: Clock,
    given: tuple[Interval, Interval],
    *,
    settings: CameraSettings | None = None,
    trigger_mode: TriggerMode | None = None,
) -> Disagreement | None:
    """Look at a flip or two, half a second, and measure in earnest where they contradict `given` (latency, settle).

    Contradicted is what cannot be: light before the least latency, darkness after the largest, change after both. A
    display that jitters within what is given is not. The first flip is seen as often as the camera can; where it was
    dark, then lit, and the least latency lies between, the second is seen once, just before the least latency: one
    that is too long by more than an exposure and `EARLIER_NS` is found out.

    A camera that rolls sees a picture that sweeps down later than it came, by as long as it rolls at most: darkness is
    believed up to so long before an exposure's end.

    Raises:
        ConfigError, SyncError, DeviceError: see `measure`.
        LateLight: the light changes later than any display's, and than what is given.
    """
    refresh = projector.capabilities.refresh_ns
    longest = max(LONGEST_REFRESHES * refresh, sum(interval.high_ns for interval in given) + refresh)
    with Shots(projector, camera, clock, settings=settings, trigger_mode=trigger_mode, light_delay_ns=longest) as shots:
        scale = _Scale(shots, _exposure(shots, refresh))
        samples = _burst(shots, scale, 0, longest)
        began, least = _began(samples, longest), given[0].low_ns
        before = least - _length(samples) - 4 * samples[0].bound_ns - EARLIER_NS
        if before > 0 and began.low_ns < least <= began.high_ns:
            samples += _burst(shots, scale, before, 0)
        shots.show(BLACK)
    began = _began(samples, longest)
    changing = max((s.start_ns - 2 * s.bound_ns for s in samples if not s.full and not s.dark), default=0)
    if not _off(given, began, changing):
        return None
    latency, settle = measure(projector, camera, clock, settings=settings, trigger_mode=trigger_mode)
    rolling = max(sample.rolling_ns for sample in samples)
    off = _off(given, Interval(max(0, latency.low_ns - rolling), latency.high_ns), latency.low_ns + settle.low_ns)
    return Disagreement(latency, settle, off) if off else None


def _began(samples: Sequence[_Sample], longest: int) -> Interval:
    """When light began: behind the last exposure that was dark, before the end of the first that was not.

    Of an exposure that rolls the first row's end counts: what sweeps down comes to that one first.
    """
    return Interval(
        max((s.end_ns - s.rolling_ns for s in samples if s.dark), default=0),
        min((s.end_ns + 2 * s.bound_ns for s in samples if not s.dark), default=longest),
    )


def _off(given: tuple[Interval, Interval], began: Interval, changing_ns: int) -> int:
    """By how much a latency that is given is certainly too long, or (negative) too short.

    began: when light began, from the flip. changing_ns: when it was changing still.
    """
    latency, settle = given
    early = latency.low_ns - began.high_ns
    late = max(began.low_ns - latency.high_ns, changing_ns - latency.high_ns - settle.high_ns)
    return early if early > 0 else -max(0, late)


class _Scale:
    """What black and white look like, block by block."""

    def __init__(self, shots: Shots, exposure_ns: int) -> None:
        shots.expose_for(exposure_ns)
        black, white = _steady(shots, BLACK, 2), _steady(shots, WHITE, 3)
        self.black, self.contrast = np.mean(black, axis=0), np.mean(white, axis=0) - np.mean(black, axis=0)
        noise = float(np.std(np.diff(white, axis=0)) / np.sqrt(2)) + 1e-3
        self.use = self.contrast > max(MIN_CONTRAST_SIGMAS * noise, 0.1 * float(self.contrast.max()), 1.0)
        if not self.use.any():
            if _comes_late(shots):
                raise _late(shots.projector, shots.light_delay_ns)
            raise SyncError(
                f"black and white differ by {self.contrast.max():.1f} grey levels, noise is {noise:.1f}",
                device=shots.camera.name,
                hint="point the camera at what the projector lights, open the lens, raise the gain, darken the room",
            )
        self.tolerance = STEADY + 4 * noise / float(self.contrast[self.use].min())

    def levels(self, shot: Shot) -> NDArray[np.float64]:
        """Of the blocks that are lit: 0 = black, 1 = white."""
        return np.asarray((_blocks(shot)[self.use] - self.black[self.use]) / self.contrast[self.use])


def _late(projector: Projector, longest_ns: int) -> LateLight:
    return LateLight(
        f"light comes later than {longest_ns / 1e6:.0f} ms after a flip",
        device=projector.name,
        hint="turn off the projector's frame interpolation and slow image modes, or choose its game mode",
    )


def _comes_late(shots: Shots) -> bool:
    """Whether black and white differ after all, `NEVER_NS` after each flip."""
    black, white = (_blocks(shots.after(shots.show(image), NEVER_NS)) for image in (BLACK, WHITE))
    return bool((white - black).max() > LATE_CONTRAST * shots.camera.capabilities.max_value)


def _steady(shots: Shots, image: int, count: int) -> list[NDArray[np.float64]]:
    """Several frames of one image after one flip."""
    first = shots.steady(image)
    return [_blocks(first), *(_blocks(shots.after(first.flip, shots.light_delay_ns)) for _ in range(count - 1))]


def _exposure(shots: Shots, refresh: int) -> int:
    """Short against a refresh where full white is steady enough at that; else one modulation period."""
    caps = shots.camera.capabilities
    short = min(max(refresh // 16, caps.exposure_min_ns), caps.exposure_max_ns)
    period = shots.projector.capabilities.modulation_period_ns
    if period is None:
        return short
    shots.expose_for(short)
    seen = [float(blocks.max()) for blocks in _steady(shots, WHITE, 4)]
    steady = np.ptp(seen) < 0.02 * np.mean(seen) and np.mean(seen) > 0.02 * caps.max_value
    return short if steady or period > caps.exposure_max_ns else period


def _burst(shots: Shots, scale: _Scale, delay_ns: int, until_ns: int) -> list[_Sample]:
    """Samples of one flip to white: the first `delay_ns` after it, the others as fast as the camera can, to the end."""
    flip = shots.show(BLACK)
    shots.clock.sleep_until(flip.t_ns + shots.light_delay_ns)
    flip = shots.show(WHITE)
    samples: list[_Sample] = []
    while not samples or (samples[-1].start_ns < until_ns and not (len(samples) > 2 and samples[-3].full)):
        samples.append(_sample(scale, shots.after(flip, delay_ns), shots.exposure_ns))
        # A camera still busy drops a trigger: the next comes when it can take one.
        period = shots.camera.capabilities.min_period_ns(shots.exposure_ns)
        delay_ns = samples[-1].start_ns + period + period // 20
    return samples


def _sample(scale: _Scale, shot: Shot, exposure_ns: int) -> _Sample:
    levels, bound, flip = scale.levels(shot), shot.exposure.bound_ns + shot.flip.bound_ns, shot.flip.t_ns
    whole_ns = shot.exposure.end_ns - shot.exposure.start_ns
    return _Sample(
        shot.exposure.start_ns + bound - flip,
        shot.exposure.end_ns - bound - flip,
        bool(levels.max() < scale.tolerance),
        bool(levels.min() > 1 - scale.tolerance),
        bound,
        max(0, whole_ns - exposure_ns),
    )


def _where_next(samples: Sequence[_Sample], *, begin: bool) -> int:
    """Delay of the exposure that halves what is not known of the change's begin, or of its end."""
    if begin:
        return max(0, sum(_begin(samples)) // 2 - _length(samples))
    return sum(_end(samples)) // 2


def _length(samples: Sequence[_Sample]) -> int:
    return int(np.median([sample.end_ns - sample.start_ns for sample in samples]))


def _begin(samples: Sequence[_Sample]) -> tuple[int, int]:
    """The earliest change began after the first of these times and before the second."""
    lit = min((s.end_ns for s in samples if not s.dark), default=0)
    return max((s.end_ns for s in samples if s.dark and s.end_ns <= lit), default=0), lit


def _end(samples: Sequence[_Sample]) -> tuple[int, int]:
    """The latest change was over after the first of these times and before the second."""
    partial = max((s.start_ns for s in samples if not s.full), default=0)
    return partial, min((s.start_ns for s in samples if s.full and s.start_ns >= partial), default=partial)


def _intervals(samples: Sequence[_Sample], tolerance: float) -> tuple[Interval, Interval]:
    dark, lit = _begin(samples)
    partial, full = _end(samples)
    # From flip to flip latency jitters: a dark exposure may end after another flip's light began.
    latest = max((s.end_ns for s in samples if s.dark), default=0)
    # Light that rises evenly over a time r from the moment x before an exposure's end has given it x^2 / (2 r) when
    # the tolerance t of its length l is reached: x = sqrt(2 r t l). Likewise at the other end; so of r only
    # r - 2 x = partial - lit was seen. Solved for sqrt(r):
    length = _length(samples)
    unseen = 2 * tolerance * length
    rise = max(length, (unseen**0.5 + (unseen + max(0, partial - lit)) ** 0.5) ** 2)
    blind = round((unseen * rise) ** 0.5)
    low, high = max(0, dark - blind), max(lit, latest + (lit - dark))
    steady = full + (full - partial) + blind
    return Interval(low, high), Interval(max(0, partial - high), max(0, steady - high))


def _blocks(shot: Shot) -> NDArray[np.float64]:
    """(BLOCKS, BLOCKS) mean grey levels."""
    pixels = shot.pixels.astype(np.float64)
    h, w = (n // BLOCKS * BLOCKS for n in pixels.shape)
    return np.asarray(pixels[:h, :w].reshape(BLOCKS, h // BLOCKS, BLOCKS, w // BLOCKS).mean(axis=(1, 3)))
