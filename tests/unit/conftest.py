"""A small rig and scenes whose truth is a formula: what the tests of geometry, scans and pictures measure against.

And the command line, run in the test's own process.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import settings
from numpy.typing import NDArray

from scanner.decode import Decoded, Reason
from scanner.devices import Truth
from scanner.geometry import Calibration, Lens
from service import cli

# How long one example takes depends on who else computes: a slow one is no failure.
settings.register_profile("shared processors", deadline=None)
settings.load_profile("shared processors")

CAMERA = (320, 240)


@dataclass(frozen=True, eq=False)
class SmallScene:
    """A scene on the small rig: what a perfect decoder would see, and the truth."""

    calibration: Calibration
    truth: Truth
    lit: NDArray[np.bool_]

    def decoded(self, noise_px: float = 0.0, axis: str = "y", seed: int = 0) -> Decoded:
        """The decoder's maps: truth plus noise where it is lit."""
        rng = np.random.default_rng(seed)
        source = self.truth.rows if axis == "y" else self.truth.columns
        noisy = source + rng.normal(0, 1, source.shape).astype(np.float32) * np.float32(noise_px)
        values = np.where(self.lit, noisy, np.nan).astype(np.float32)
        sigma = np.where(self.lit, np.float32(max(noise_px, 1e-3)), np.nan).astype(np.float32)
        shade = np.where(self.lit, 120.0, 4.0).astype(np.float32)
        return Decoded(
            rows=values if axis == "y" else None,
            columns=values if axis == "x" else None,
            sigma_rows=sigma if axis == "y" else None,
            sigma_columns=sigma if axis == "x" else None,
            confidence=self.lit.astype(np.float32),
            albedo=shade,
            modulation=shade * np.float32(0.9),
            reason=np.where(self.lit, Reason.VALUE, Reason.SHADOW).astype(np.uint8),
        )


def small_rig(
    axis: str = "y", camera_k: tuple[float, ...] = (0.0,) * 5, projector_k: tuple[float, ...] = (0.0,) * 5
) -> Calibration:
    """Projector 200 mm above (axis y) or beside (axis x) the camera, both aimed at (0, 0, 700) mm."""
    camera = Lens(CAMERA, np.array([[620.0, 0, 159.5], [0, 620.0, 119.5], [0, 0, 1]]), np.array(camera_k))
    projector = Lens((400, 300), np.array([[700.0, 0, 199.5], [0, 690.0, 149.5], [0, 0, 1]]), np.array(projector_k))
    angle = np.arctan2(200.0, 700.0)
    centre = np.array([0, -200.0, 0]) if axis == "y" else np.array([200.0, 0, 0])
    turn = np.array([angle, 0, 0]) if axis == "y" else np.array([0, angle, 0])
    rotation = np.asarray(cv2.Rodrigues(turn)[0])
    return Calibration(camera, projector, rotation, -rotation @ centre, id=f"small-{axis}")


def scene_of(
    calibration: Calibration, depth: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
) -> SmallScene:
    """The scene whose depth along the ray (x, y, 1) is `depth(x, y)`; lit wherever the projector's image reaches."""
    rays = calibration.camera.normalised(calibration.camera.pixel_grid())
    x, y = rays[..., 0], rays[..., 1]
    z = depth(x, y)
    xyz = np.stack((x * z, y * z, z), axis=-1)
    seen = calibration.projector.project(calibration.to_projector(xyz))
    width, height = calibration.projector.size
    lit = (np.abs(seen[..., 0] - (width - 1) / 2) < width / 2) & (np.abs(seen[..., 1] - (height - 1) / 2) < height / 2)
    truth = Truth(seen[..., 1].astype(np.float32), seen[..., 0].astype(np.float32), xyz.astype(np.float32), lit)
    return SmallScene(calibration, truth, lit)


def ball_before_wall(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sphere of radius 50 mm at (0, 0, 640) before a wall at 760 mm."""
    a, b = x * x + y * y + 1, np.full(x.shape, 640.0)
    inside = b * b - a * (640.0**2 - 50.0**2)
    return np.where(inside > 0, (b - np.sqrt(np.maximum(inside, 0))) / a, 760.0)


@pytest.fixture(scope="session")
def rig_of() -> Callable[..., Calibration]:
    """`small_rig`."""
    return small_rig


@pytest.fixture(scope="session")
def scene_with() -> Callable[..., SmallScene]:
    """`scene_of`."""
    return scene_of


@pytest.fixture(scope="session")
def ball() -> SmallScene:
    """Sphere and wall, projector above."""
    return scene_of(small_rig("y"), ball_before_wall)


@pytest.fixture
def run(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[..., tuple[int, str, str]]:
    """Run a command in `tmp_path`: (status, standard output, standard error)."""
    monkeypatch.chdir(tmp_path)

    def runs(*words: Any) -> tuple[int, str, str]:
        capsys.readouterr()
        status = cli.main([str(word) for word in words])
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        assert "error: unexpected" not in captured.err, captured.err
        return status, captured.out, captured.err

    return runs
