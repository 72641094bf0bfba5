"""What becomes of a picture on its way: whether pixels stay pixels, whether the lamp follows the content, what other
light there is, and whether the projector refreshes at the rate it says.

Test shots outside a run, of the part that the projector lights. Keystone, overscan and scaling make new pixels out of
neighbours; dynamic contrast, iris and automatic exposure change all greys with the mean of the picture. All of it is
smooth to the eye and spoils fringes without a message.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.clock import Clock
from scanner.devices import Camera, CameraSettings, Flip, Projector, Source, TriggerMode
from scanner.sequencer.light import FRAMES, fitting_exposure, grey_levels, lit_part
from scanner.sequencer.shots import BLACK, WHITE, Shots

CHECKER, PATCH = 2, 3

FLIPS = 60
"""One second of them: 59.94 and 60 Hz then differ by 17 us, and stamps of the kernel are good to 20"""

CORE = 0.5
"""The patch's half height and width, of the picture's"""


@dataclass(frozen=True)
class Picture:
    """What was measured."""

    checker: float
    """light of a checker of single pixels, of white's: a half, whatever the gamma, as long as every pixel is either
    black or white. Pixels made from two neighbours have less light than their mean: at gamma 2.2 a fifth of white's
    half way between black and white, and over all phases of a scaled picture a third (1 / (1 + gamma))"""
    patch: float
    """light of a white patch on black, of the same place's in a white picture: 1, and more by stray light"""
    room: float
    """standard deviation of black from frame to frame, of white minus black: other light that swings"""
    refresh_ns: float | None
    """measured over a second of flips; None where their stamps are estimates"""


def measure_picture(
    projector: Projector,
    camera: Camera,
    clock: Clock,
    *,
    settings: CameraSettings | None = None,
    trigger_mode: TriggerMode | None = None,
) -> Picture:
    """Measure, on a projector that shows any image; those in it are replaced, the camera is left stopped.

    Raises:
        ConfigError: the camera can neither be triggered by software nor run free.
        SyncError: black and white cannot be told apart.
        DeviceError: a device failed.
    """
    size = projector.capabilities
    with Shots(projector, camera, clock, settings=settings, trigger_mode=trigger_mode) as shots:
        fitting_exposure(shots, size.refresh_ns)
        images = _images(size.height, size.width)
        projector.load(images)
        shots.images = len(images)
        black, white = grey_levels(shots, BLACK), grey_levels(shots, WHITE)
        lit = lit_part(white - black, camera.capabilities.max_value, shots)
        share = [np.where(lit, (grey_levels(shots, i) - black) / np.where(lit, white - black, 1), 0) for i in (2, 3)]
        dark = [grey_levels(shots, BLACK)[lit].mean() for _ in range(FRAMES)]
        room = float(np.std(dark, ddof=1) / (white - black)[lit].mean())
        return Picture(float(share[0][lit].mean()), _core(share[1], lit), room, _refresh(shots))


def _images(height: int, width: int) -> list[NDArray[np.uint8]]:
    """Black, white, a checker of single pixels, and a white patch on black."""
    rows, columns = np.indices((height, width))
    patch = np.zeros((height, width), np.uint8)
    top, left = round(height * (1 - CORE) / 2), round(width * (1 - CORE) / 2)
    patch[top : height - top, left : width - left] = 255
    checker = np.where((rows + columns) % 2 == 0, 0, 255).astype(np.uint8)
    return [np.zeros_like(patch), np.full_like(patch, 255), checker, patch]


def _core(share: NDArray[np.float64], lit: NDArray[np.bool_]) -> float:
    """The patch's light: where it has more than half of what it has where it is brightest."""
    brightest = float(np.percentile(share[lit], 95))
    return float(np.median(share[lit & (share > brightest / 2)])) if brightest > 0 else 0.0


def _refresh(shots: Shots) -> float | None:
    flips: list[Flip] = [shots.show(n % 2) for n in range(FLIPS)]
    first, last = flips[0], flips[-1]
    if first.source is Source.ESTIMATED or last.vblank <= first.vblank:
        return None
    return (last.t_ns - first.t_ns) / (last.vblank - first.vblank)
