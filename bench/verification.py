"""How honest the uncertainties of `fringed calibrate verify` are: shares of scans whose figures lie within U.

    python bench/verification.py [--calibration FILE] [--draws 120]

Points by geometry, no pictures: a wall that fills the camera's picture (flat, and bent by 0.4 mm), a ball before it, a
charuco target, as rigs see them that the calibration's covariance allows, with noise along the rays. The calibration is
casey2011's true one with a made-up covariance, each parameter on its own (SIGMAS); FILE: a calibration that was solved.

A row a figure: what the true rig shows, in the mean of many scans (of a length: what it is); the half-width that holds
95.45 % of the errors; the median U; the share of scans within their own U, in per cent; asked for are 92 to 98. Of
`repeat`: scans of one scene with noise, or drift of the whole picture, or both alike. Exit status 1 if a share is below
85: of 120 draws chance leaves a row of 92 there three times in a thousand.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

import cv2
import numpy as np

from drivers.simulated.rigs import rig as simulated_rig
from scanner.calibration.detection import Detection
from scanner.calibration.figure_spread import BOARD, SPHERE, Rig, spread_of_figures, spread_of_length
from scanner.calibration.repeat_spread import half_width
from scanner.calibration.targets import parse_target
from scanner.calibration.verification import FeaturePoints, local_point
from scanner.geometry import load_calibration

SIGMAS = {
    "camera.fx": 0.15, "camera.fy": 0.15, "camera.k1": 1e-3, "camera.k2": 0.01, "camera.p1": 2e-5,
    "projector.fx": 0.1, "projector.fy": 0.1, "projector.k1": 1e-3, "projector.k2": 0.01, "projector.p1": 3e-5,
    "rotation.x": 4e-5, "rotation.y": 6e-5, "translation.y": 0.05, "translation.z": 0.03,
}  # fmt: skip
"""1-sigma, about what a dozen poses of a target leave: px, 1, rad, mm"""

STEP = 14
"""Every so many pixels of the picture: calibrations move neighbours alike"""

LEAST_SHARE = 0.85


class Views:
    """The rig, and what its camera would see of the features if nothing were off."""

    def __init__(self, file: str | None) -> None:
        known = simulated_rig("casey2011")
        covariance = {"parameters": list(SIGMAS), "matrix": np.diag(np.square(list(SIGMAS.values()))).tolist()}
        made_up = replace(known.calibration, extra={**known.calibration.extra, "covariance": covariance})
        self.calibration = made_up if file is None else load_calibration(file)
        self.rig = Rig(self.calibration, self.calibration.phase_axis)
        self.width, self.height = self.calibration.camera.size
        self.distance = float(known.aim[2])

    def rays(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """(n,) places in the picture, flat, and (n, 3) rays with z = 1."""
        v, u = np.mgrid[: self.height : step, : self.width : step].reshape(2, -1)
        plane = self.calibration.camera.normalised(np.stack((u, v), axis=1).astype(np.float64))
        return v * self.width + u, np.column_stack((plane, np.ones(len(plane))))

    def wall(self, bow_mm: float) -> tuple[np.ndarray, np.ndarray]:
        """Places and points of a wall that faces the camera, its middle nearer by the bow."""
        at, rays = self.rays(STEP)
        away = (rays[:, :2] ** 2).sum(axis=1)
        return at, rays * (self.distance + bow_mm * away / away.max())[:, None]

    def ball(self) -> tuple[np.ndarray, np.ndarray]:
        """Places and points of a ball, a tenth of its radius away from its outline."""
        at, rays = self.rays(STEP // 3)
        radius = 0.06 * self.distance
        centre = np.array([0.0, 0.0, 0.93 * self.distance])
        b, a = rays @ centre, (rays**2).sum(axis=1)
        root = b**2 - a * (centre @ centre - radius**2)
        seen = root > 0.2 * radius**2 * a
        depth = (b[seen] - np.sqrt(root[seen])) / a[seen]
        return at[seen], rays[seen] * depth[:, None]


def features(views: Views, draws: int) -> list[float]:
    """Rows of boards and balls; the shares within U."""
    shares = []
    for name, noise, bow in (("board", 0.07, 0.0), ("board", 0.02, 0.0), ("board", 0.07, -0.4), ("ball", 0.03, 0.0)):
        at, points = views.ball() if name == "ball" else views.wall(bow)
        feature = SPHERE if name == "ball" else BOARD
        generator, along = np.random.default_rng(5), points / points[:, 2:]
        moves = views.rig.spread(points, at // views.width, at % views.width).draws(draws, 99)
        clouds = [points + along * generator.normal(0, noise, len(at))[:, None] for _ in range(40 + draws)]
        true = [feature.figures(cloud) for cloud in clouds[:40]]
        scans = [cloud + move for cloud, move in zip(clouds[40:], moves, strict=True)]
        found = [feature.figures(scan) for scan in scans]
        stated = [spread_of_figures(FeaturePoints(scan, at, 1.0), views.width, feature, views.rig) for scan in scans]
        for figure in true[0]:
            wanted = float(np.mean([one[figure] for one in true]))
            errors = [one[figure] - wanted for one in found]
            label = f"{name} {bow:+.1f}" if bow else name
            shares.append(row(f"{label:10} {noise:.2f} {figure}", wanted, errors, [s[figure].expanded for s in stated]))
    return shares


def lengths(views: Views, draws: int) -> list[float]:
    """Rows of a target's longest row, by noise of points and of its marks in the picture; the shares."""
    target, shares = parse_target("charuco:10x7:30"), []
    turn = np.asarray(cv2.Rodrigues(np.array([0.2, 0.1, 0.3]))[0])
    marks = (target.points - target.points.mean(axis=0)) @ turn.T + np.array([0.0, 0.0, views.distance])
    pixels = views.calibration.camera.project(marks)
    places, rays = views.rays(1)
    near = np.zeros((views.height, views.width), np.uint8)
    near[np.rint(pixels[:, 1]).astype(int), np.rint(pixels[:, 0]).astype(int)] = 1
    here = np.flatnonzero(cv2.dilate(near, np.ones((9, 9), np.uint8)))
    points = rays[here] * (turn[:, 2] @ marks[0] / (rays[here] @ turn[:, 2]))[:, None]
    moves = views.rig.spread(points, places[here] // views.width, places[here] % views.width).draws(draws, 98)
    for noise, off_px in ((0.05, 0.03), (0.02, 0.15)):
        generator, errors, stated = np.random.default_rng(3), [], []
        for move in moves:
            xyz = np.full((views.height * views.width, 3), np.nan, np.float32)
            xyz[here] = points + move + rays[here] * generator.normal(0, noise, len(here))[:, None]
            xyz = xyz.reshape(views.height, views.width, 3)
            seen = Detection(
                np.arange(len(pixels)), pixels + generator.normal(0, off_px, pixels.shape), np.full(len(pixels), 20.0)
            )
            first, last = (local_point(xyz, seen.points[number]) for number in target.longest)
            errors.append(float(np.linalg.norm(last - first)) - target.longest_mm)
            stated.append(spread_of_length(seen, target, xyz, views.rig).expanded)
        shares.append(row(f"length     {noise:.2f} {off_px:.2f} px", target.longest_mm, errors, stated))
    return shares


def repeats(draws: int) -> list[float]:
    """Rows of repeatability; the shares."""
    shares, generator = [], np.random.default_rng(1)
    for scans in (3, 5, 20):
        for drift in (0.0, 1.0, 10.0):
            noise, errors, stated = np.exp(0.5 * generator.normal(size=4000)), [], []
            wanted = float(np.sqrt(np.mean(noise**2) + drift**2))
            for _ in range(draws):
                values = noise * generator.normal(size=(scans, 4000)) + drift * generator.normal(size=(scans, 1))
                errors.append(float(np.sqrt(values.var(axis=0, ddof=1).mean())) - wanted)
                stated.append(half_width(values))
            shares.append(row(f"repeat     {scans} scans, drift {drift:g}", wanted, errors, stated))
    return shares


def row(label: str, wanted: float, errors: list[float], stated: list[float]) -> float:
    """Print one; the share within."""
    off, within = np.abs(errors), np.array(stated)
    share = float((off < within).mean())
    print(
        f"{label:34} {wanted:10.4f} {np.quantile(off, 0.9545):9.4f} {np.median(within):9.4f} {100 * share:7.1f}",
        flush=True,
    )
    return share


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calibration", help="a calibration file with covariance")
    parser.add_argument("--draws", type=int, default=120)
    chosen = parser.parse_args()
    views = Views(chosen.calibration)
    print("feature, noise mm, figure               true   95.45 %  median U   share")
    shares = [*features(views, chosen.draws), *lengths(views, chosen.draws), *repeats(chosen.draws)]
    return int(min(shares) < LEAST_SHARE)


if __name__ == "__main__":
    sys.exit(main())
