"""A made-up rig and its views of a target, for the tests of calibration: points by geometry, no pictures."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from scanner.calibration.observe import Observation
from scanner.calibration.problem import View
from scanner.calibration.targets import Target, parse_target
from scanner.geometry import Calibration, Lens

CAMERA_SIZE, PROJECTOR_SIZE = (1280, 1024), (1024, 768)
TARGET = parse_target("chessboard:9x6:30")


def made_up_rig(centre: Sequence[float] = (220.0, 15.0, 0.0), turn: Sequence[float] = (0.01, 0.3, 0.02)) -> Calibration:
    """A camera of 2000 px and a projector with its axis below its picture, both distorted."""
    camera = Lens(CAMERA_SIZE, _matrix(2000.0, 2004.0, 650.0, 500.0), np.array([-0.08, 0.03, 4e-4, -2e-4, 0.0]))
    projector = Lens(PROJECTOR_SIZE, _matrix(1500.0, 1498.0, 520.0, 760.0), np.array([-0.03, 0.01, 0.0, 3e-4, 0.0]))
    rotation = np.asarray(cv2.Rodrigues(np.array(turn))[0], dtype=np.float64)
    # Turned so that the middle of its picture, not its axis, lands near the middle of the camera's.
    pitch = np.asarray(cv2.Rodrigues(np.array([-0.25, 0.0, 0.0]))[0], dtype=np.float64)
    rotation = pitch @ rotation
    return Calibration(camera, projector, rotation, -rotation @ np.asarray(centre, dtype=np.float64))


def poses(
    count: int = 12, seed: int = 1, tilt_deg: float = 30.0, depth: tuple[float, float] = (600.0, 800.0)
) -> np.ndarray:
    """(count, 6): rotation vector and translation, mm."""
    generator = np.random.default_rng(seed)
    about = generator.uniform(0, 2 * np.pi, count)
    tilt = np.radians(tilt_deg) * np.sqrt(generator.uniform(0.1, 1, count))
    turns = np.column_stack((np.cos(about) * tilt, np.sin(about) * tilt, np.radians(generator.uniform(-15, 15, count))))
    where = generator.uniform((-50, -35), (50, 35), (count, 2))
    return np.column_stack((turns, where, np.linspace(*depth, count)))


def view_of(
    rig: Calibration,
    pose: np.ndarray,
    name: str,
    *,
    target: Target = TARGET,
    sheet: Sequence[float] = (1.0, 1.0, 1.0),
    noise: tuple[float, float] = (0.02, 0.005),
    seed: int = 0,
) -> View:
    """What detection and phase would give of a pose: the projector's pixel is read where the camera saw the point."""
    generator = np.random.default_rng([seed, len(name), *name.encode()])
    points = target.points * np.asarray(sheet)
    in_camera = points @ np.asarray(cv2.Rodrigues(pose[:3])[0]).T + pose[3:]
    camera = rig.camera.project(in_camera)
    projector = rig.projector.project(rig.to_projector(in_camera))
    slope = _slopes(rig, pose, camera)
    off = generator.normal(0, noise[0], camera.shape)
    read = projector + (slope @ off[..., None])[..., 0] + generator.normal(0, noise[1], camera.shape)
    return View(name, np.arange(len(points)), camera + off, read, np.full(camera.shape, noise[1] or 1e-3), slope)


def observations(
    rig: Calibration, every: np.ndarray, *, target: Target = TARGET, **options: object
) -> list[Observation]:
    """Of every pose, named pose00, pose01, ..."""
    views = [view_of(rig, pose, f"pose{k:02d}", target=target, **options) for k, pose in enumerate(every)]  # type: ignore[arg-type]
    return [Observation(view, rig.camera.size, rig.projector.size) for view in views]


def _matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _slopes(rig: Calibration, pose: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """(N, 2, 2): projector px per camera px on the target's plane."""
    rotation = np.asarray(cv2.Rodrigues(pose[:3])[0])
    normal, shift = rotation[:, 2], pose[3:]

    def seen(pixels: np.ndarray) -> np.ndarray:
        rays = np.column_stack((rig.camera.normalised(pixels), np.ones(len(pixels))))
        return rig.projector.project(rig.to_projector(rays * (normal @ shift / (rays @ normal))[:, None]))

    steps = [(seen(camera + e) - seen(camera - e)) / 2 for e in (np.array([1.0, 0.0]), np.array([0.0, 1.0]))]
    return np.stack(steps, axis=-1)
