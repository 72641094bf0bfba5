"""What a rig's light is like: how black and white differ, whether greys are built over time, flicker, gamma.

Test shots of flat images, outside a run. It measures what spoils fringes without any error message: a projector that
makes grey by pulses needs exposures of whole pulses, a lamp or room light that swings needs longer ones, and a gamma
that nobody undid ripples (`precorrection`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.clock import Clock
from scanner.devices import Camera, CameraSettings, Projector, ProjectorKind, TriggerMode
from scanner.errors import SyncError
from scanner.sequencer.shots import BLACK, WHITE, Shots

GREYS = (0, 48, 96, 144, 192, 255)
"""Levels that show a gamma: two parameters (black, white) and an exponent leave three to judge the fit by"""

MIDDLE_GREY = 144

FRAMES = 12
"""Frames of steady white: their scatter is known to a fifth (1 / sqrt(2 (n - 1)))"""

SPARED = 0.9
"""Share of the camera's range that the brightest part may reach: clipped light tells nothing."""

LEAST_CONTRAST = 0.05
"""Of the camera's range, between black and white: less drowns in quantisation (13 of 256 levels)"""


@dataclass(frozen=True)
class Light:
    """What was measured; levels are grey levels of the camera, of the part of the image that the projector lights."""

    black: float
    white: float
    exposure_ns: int
    """at which black and white were taken"""
    lit_share: float
    """of the image"""
    pulsing: float
    """relative standard deviation of a middle grey over exposures of an eighth of a refresh, spread evenly over its
    phases: 0 for constant light, 1 and more where a grey is pulses of white"""
    flicker: float
    """relative standard deviation of white at the exposure above, camera noise of the mean taken off"""
    gamma: float | None
    """exponent of grey levels; None on a projector that shows one image only"""
    gamma_misfit: float
    """rms of what a pure exponent leaves, of white minus black"""


def measure_light(
    projector: Projector,
    camera: Camera,
    clock: Clock,
    *,
    settings: CameraSettings | None = None,
    trigger_mode: TriggerMode | None = None,
) -> Light:
    """Measure; the images in the projector are replaced, the camera is left stopped.

    Args:
        settings: gain, format and region to measure with; their exposure is not used.

    Raises:
        ConfigError: the camera can neither be triggered by software nor run free.
        SyncError: black and white cannot be told apart.
        DeviceError: a device failed.
    """
    static = projector.capabilities.kind is ProjectorKind.STATIC
    refresh = projector.capabilities.refresh_ns
    with Shots(projector, camera, clock, settings=settings, trigger_mode=trigger_mode) as shots:
        exposure = fitting_exposure(shots, refresh)
        black = np.zeros((1, 1)) if static else grey_levels(shots, BLACK)
        white = grey_levels(shots, WHITE)
        lit = lit_part(white - black, camera.capabilities.max_value, shots)
        means = np.array([grey_levels(shots, WHITE)[lit].mean() for _ in range(FRAMES)])
        gamma, misfit = (None, 0.0) if static else _gamma(shots, lit)
        shots.expose_for(max(refresh // 8, camera.capabilities.exposure_min_ns))
        short_dark = 0.0 if static else float(grey_levels(shots, BLACK)[lit].mean())
        short = _over_a_refresh(shots, refresh, lit)
    dark = float(black[lit].mean()) if not static else 0.0
    return Light(
        dark,
        float(white[lit].mean()),
        exposure,
        float(lit.mean()),
        _scatter(short, short_dark),
        _scatter(means, dark),
        gamma,
        misfit,
    )


def fitting_exposure(shots: Shots, refresh: int) -> int:
    """A refresh, or the longest of its halves, quarters ... at which white does not clip."""
    caps = shots.camera.capabilities
    exposure = refresh
    for _ in range(8):
        shots.expose_for(exposure)
        top = float(np.percentile(grey_levels(shots, WHITE), 99.5))
        if top < SPARED * caps.max_value or exposure // 2 < caps.exposure_min_ns:
            break
        exposure //= 2
    return exposure


def grey_levels(shots: Shots, image: int) -> NDArray[np.float64]:
    """A steady image of the projector's as the camera sees it."""
    return shots.steady(image).pixels.astype(np.float64)


def lit_part(contrast: NDArray[np.float64], max_value: int, shots: Shots) -> NDArray[np.bool_]:
    """Where the projector makes a difference, at least a quarter of what it makes at best."""
    most = float(np.percentile(contrast, 99))
    if most < LEAST_CONTRAST * max_value:
        raise SyncError(
            f"black and white differ by {max(0.0, most):.1f} of {max_value} grey levels",
            device=shots.camera.name,
            hint="point the camera at what the projector lights, open the lens, raise the gain, darken the room",
        )
    return contrast > 0.25 * most


def _over_a_refresh(shots: Shots, refresh: int, lit: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Means of a steady grey (or the one image there is), each exposed at another phase of the refresh."""
    flip = shots.show(GREYS.index(MIDDLE_GREY))
    delays = (shots.light_delay_ns + round((n + n / FRAMES) * refresh) for n in range(FRAMES))
    return np.array([shots.after(flip, delay).pixels[lit].mean() for delay in delays], np.float64)


def _scatter(means: NDArray[np.float64], dark: float) -> float:
    return float(np.std(means, ddof=1) / max(1e-9, means.mean() - dark))


def _gamma(shots: Shots, lit: NDArray[np.bool_]) -> tuple[float, float]:
    """Exponent of I = black + (white - black) (v / 255)^g by least squares, and the rms it leaves."""
    size = shots.projector.capabilities
    levels = np.array(GREYS)
    shots.projector.load([np.full((size.height, size.width), level, np.uint8) for level in GREYS])
    shots.images = len(GREYS)
    seen = np.array([grey_levels(shots, i)[lit].mean() for i in range(len(GREYS))])
    share = np.clip((seen - seen[0]) / max(1e-9, seen[-1] - seen[0]), 1e-6, None)
    inner = slice(1, -1)
    x, y = np.log(levels[inner] / 255), np.log(share[inner])
    weight = share[inner] ** 2  # an error of the level is one of its logarithm divided by it
    gamma = float((weight * x * y).sum() / (weight * x * x).sum())
    left = share - (levels / 255) ** gamma
    return gamma, float(np.sqrt(np.mean(left**2)))
