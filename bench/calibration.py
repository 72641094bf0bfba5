"""How right a rig's calibration is, on the simulated rigs and on real corners.

    python bench/calibration.py poses [--seeds 3] [--rigs casey2011,bench2026]
                                       [--targets charuco,chessboard,circles,acircles]
    python bench/calibration.py planes [--seeds 1] [--rig casey2011]
    python bench/calibration.py sphere [--seeds 1] [--rig casey2011]
    python bench/calibration.py wedge [--seeds 1] [--rig casey2011]
    python bench/calibration.py real FOLDER            (corners.npz and capture.json of issue 4's real data)

`poses`: the 12 simulated poses of scenes.json, both axes, (1, 8, 64) x 8; for each rig and target the median over
seeds of the largest error of the four focal lengths (%), of the four principal coordinates (px), of the translation's
length of error (mm), and the share of those eleven numbers within two stated sigmas. Target's length stated to 0.01 mm.
`planes`: rigs calibrated so measure boards at three depths (100 mm nearer, at the aim, 70 mm farther: the range of the
poses), and tilted by 30 degrees both ways, by PMP and by MCP: flatness (worst of 9 places of a board: rms from the best
plane), shape (rms after a rigid fit of a whole board to truth), position (rms against truth); inside, 7 px from edges.
`sphere`: such rigs measure the ball before the board, by (1, 8, 64) x 8 or --shifts: radius less the true one; form as
rms of the radial distances, as the thinnest shell that holds 95 of 100 (ISO 10360-8, dispersion), as the spread of
997 of 1000 of them (PF of VDI/VDE 2634-2), and that of a perfect ball with what near points differ by.
`wedge`: the dissertation's own procedure, the wedge with 18 discs and the Hall model, then the board in rows: rms in
depth in the wedge's frame, with and without the discs' correction for perspective.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from drivers.registry import open_camera, open_projector
from drivers.simulated.rigs import reference
from drivers.simulated.rigs import rig as simulated_rig
from drivers.simulated.targets import wedge_planes, wedge_points
from scanner.calibration.balls import sphere_points
from scanner.calibration.beyond_noise import beyond_noise
from scanner.calibration.figure_spread import SPHERE
from scanner.calibration.hall import triangulate_hall
from scanner.calibration.lens_slopes import lens_numbers
from scanner.calibration.observe import LeftOut, Observation, observe_capture, observe_decoded
from scanner.calibration.problem import View
from scanner.calibration.solve import SolveOptions, sigmas, solve
from scanner.calibration.solve_hall import solve_hall
from scanner.calibration.targets import parse_target
from scanner.calibration.verification import measured_sphere
from scanner.clock import VirtualClock
from scanner.decode import decoder_for
from scanner.devices import CameraSettings, TriggerMode
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, PmpPattern, ProjectorSize
from scanner.patterns.sequence import Precorrection
from scanner.triangulation import triangulate

SPECS = {
    "charuco": "charuco:10x7:30",
    "chessboard": "chessboard:9x6:30",
    "circles": "circles:8x5:30:15",
    "acircles": "acircles:5x7:22.5:18",
}
POSES = 12
BOTH_AXES = PmpPattern(axes=("x", "y"), frequencies=(1.0, 8.0, 64.0), shifts=(8, 8, 8))
LENGTH_SIGMA_MM = 0.01


def take(device, pattern, exposure_ns=30_000_000):
    """Decoded maps of one simulated scene, its truth and the true calibration."""
    clock = VirtualClock()
    camera = open_camera("simulated", device, {}, clock)
    projector = open_projector("simulated", device, {}, clock)
    cap = camera.capabilities
    size = ProjectorSize(projector.capabilities.width, projector.capabilities.height)
    sequence = PatternSequence(size, pattern, precorrection=Precorrection(gamma=2.3))
    decoder = decoder_for(sequence, CameraFormat(cap.width, cap.height, cap.bits))
    camera.apply(CameraSettings(exposure_ns=exposure_ns))
    projector.load([sequence.image(k) for k in range(len(sequence))])
    camera.start(TriggerMode.SOFTWARE)
    for k in range(len(sequence)):
        projector.show(k)
        clock.sleep_until(clock.now_ns() + 100_000_000)
        camera.trigger()
        decoder.add(k, camera.pop(1_000_000_000).pixels)
    found = decoder.finish(), camera.truth(), camera.true_calibration()
    camera.close()
    projector.close()
    return found


def calibrated(rig, target, seed):
    """(solution, true calibration, seconds of solving) from the simulated poses."""
    spec = parse_target(SPECS[target])
    observations, left_out = [], []
    for k in range(POSES):
        decoded, _, true = take(f"{rig}/{target}_poses?pose={k}&seed={seed}", BOTH_AXES)
        view = observe_decoded(f"pose{k:02d}", decoded, spec)
        if isinstance(view, LeftOut):
            left_out.append(view)
        else:
            observations.append(Observation(view, true.camera.size, true.projector.size))
    begun = time.perf_counter()
    options = SolveOptions(length=(spec.longest_mm, LENGTH_SIGMA_MM))
    solution = solve(spec, observations, options, left_out)
    return solution, true, time.perf_counter() - begun


def errors(solution, true):
    """Focal lengths (4) %, principal coordinates (4) px, translation (3) mm, and all eleven over their sigmas."""
    spread = sigmas(solution.adjusted)
    state = solution.state
    focal, centre, ratios = [], [], []
    for side in ("camera", "projector"):
        found, wanted = lens_numbers(getattr(state, side)), lens_numbers(getattr(true, side))
        off = found - wanted
        focal += list(100 * off[:2] / wanted[:2])
        centre += list(off[2:4])
        ratios += list(off[:4] / spread[side][:4])
    shift = state.translation - true.translation
    ratios += list(shift / spread["translation"])
    return np.abs(focal), np.abs(centre), shift, np.abs(ratios)


def poses(chosen):
    print("rig        target      seeds  focal %   centre px  shift mm   in 2 sigma  in 1 sigma  left out   solve s")
    for rig in chosen.rigs.split(","):
        for target in chosen.targets.split(","):
            rows, ratios, out, spent = [], [], 0, []
            for seed in range(chosen.first, chosen.first + chosen.seeds):
                solution, true, seconds = calibrated(rig, target, seed)
                focal, centre, shift, off = errors(solution, true)
                rows.append((focal.max(), centre.max(), np.linalg.norm(shift)))
                ratios.append(off)
                out += len(solution.left_out)
                spent.append(seconds)
            median = np.median(rows, axis=0)
            every = np.concatenate(ratios)
            print(
                f"{rig:10} {target:10} {chosen.seeds:6} {median[0]:8.4f} {median[1]:10.3f} {median[2]:9.4f} "
                f"{np.mean(every < 2):12.3f} {np.mean(every < 1):11.3f} {out:9} {np.median(spent):9.2f}",
                flush=True,
            )


BOARDS = ((0, -100), (0, 0), (0, 70), (-30, 0), (30, 0))
"""Tilt, degrees, and offset in depth, mm of casey2011"""


def planes(chosen):
    print("method  tilt  offset   flatness mm (worst of 9)   shape mm   position mm")
    for seed in range(chosen.first, chosen.first + chosen.seeds):
        solution, true, _ = calibrated(chosen.rig, chosen.target, seed)
        rig = solution.geometry
        axis = true.phase_axis
        for method in ("pmp", "mcp"):
            for degrees, offset in BOARDS:
                pattern = PmpPattern(axes=(axis,)) if method == "pmp" else McpPattern(axis=axis)
                about = "y" if axis == "y" else "x"
                device = f"{chosen.rig}/tilt?tilt_deg={degrees}&about={about}&offset_mm={offset}&seed={seed}"
                decoded, truth, _ = take(device, pattern)
                xyz = triangulate(rig, rows=decoded.rows, columns=decoded.columns).xyz
                figures = _plane_figures(xyz, truth)
                print(
                    f"{method:6} {degrees:5} {offset:7} {figures[0]:12.4f} {figures[1]:22.4f} {figures[2]:12.4f}",
                    flush=True,
                )


def spheres(chosen):
    radius = reference()["scenes"]["sphere_board"]["radius_mm"] * simulated_rig(chosen.rig).scale
    print("calibration   radius error mm   rms mm   95 % mm   PF (99.7 %) mm   of noise alone mm   points")
    for seed in range(chosen.first, chosen.first + chosen.seeds):
        solution, true, _ = calibrated(chosen.rig, chosen.target, seed)
        pattern = PmpPattern(axes=(true.phase_axis,), frequencies=(1.0, 8.0, 64.0), shifts=(chosen.shifts,) * 3)
        decoded, truth, _ = take(f"{chosen.rig}/sphere_board?seed={seed}", pattern)
        inside = cv2.erode(truth.lit.astype(np.uint8), np.ones((15, 15), np.uint8)).astype(bool)
        for name, rig in (("own", solution.geometry), ("true", true)):
            made = triangulate(
                rig, rows=decoded.rows, columns=decoded.columns,
                sigma_rows=decoded.sigma_rows, sigma_columns=decoded.sigma_columns,
            )  # fmt: skip
            made.xyz[~inside] = np.nan
            on = sphere_points(made.xyz, 2 * radius)
            found = measured_sphere(on, 2 * radius)
            told = beyond_noise(SPHERE.deviations(on.points).off, on.at, truth.lit.shape, SPHERE.widths["form_mm"])
            noise = float("nan") if told is None else told.noise_mm
            print(
                f"{name:11} {found.size_mm / 2:+17.4f} {found.rms_mm:8.4f} {found.shell_mm:9.4f} {found.form_mm:16.4f} "
                f"{noise:19.4f} {found.points:8}",
                flush=True,
            )


def _plane_figures(xyz, truth):
    inside = np.zeros(truth.lit.shape, bool)
    inside[7:-7, 7:-7] = truth.lit[7:-7, 7:-7]
    good = inside & np.isfinite(xyz).all(axis=-1) & np.isfinite(truth.xyz).all(axis=-1)
    height, width = good.shape
    flat = []
    for i in range(3):
        for j in range(3):
            place = np.zeros_like(good)
            place[i * height // 3 : (i + 1) * height // 3, j * width // 3 : (j + 1) * width // 3] = True
            points = xyz[good & place].astype(np.float64)
            if len(points) > 1000:
                flat.append(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(points)))
    found, wanted = xyz[good].astype(np.float64), truth.xyz[good].astype(np.float64)
    off = found - wanted
    return max(flat), np.sqrt((_fitted(found, wanted)[:, 2] ** 2).mean()), np.sqrt((off**2).sum(axis=1).mean())


def _fitted(found, wanted):
    """What is left of `found` against `wanted` after the best rotation and translation (Kabsch 1976), mm."""
    a, b = found - found.mean(axis=0), wanted - wanted.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return a @ turn - b


def wedge(chosen):
    rig = simulated_rig(chosen.rig)
    points = wedge_points(rig)
    normals = np.concatenate([np.tile(np.cross(p.u, p.v), (9, 1)) for p in wedge_planes()])
    normals *= -np.sign(normals[:, 2:])
    middle = points.mean(axis=0)
    diameter = 2 * reference()["scenes"]["wedge"]["discs"]["radius_mm"] * rig.scale
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "wedge.json"
        content = {"format": "fringed-target", "version": 1, "diameter_mm": diameter}
        content["points"] = (points - middle).tolist()
        file.write_text(json.dumps({**content, "normals": normals.tolist()}))
        corrected = parse_target(f"wedge:{file}")
        file.write_text(json.dumps(content))
        plain = parse_target(f"wedge:{file}")
    for seed in range(chosen.first, chosen.first + chosen.seeds):
        decoded, _, true = take(f"{chosen.rig}/wedge?seed={seed}", BOTH_AXES)
        view = observe_decoded("wedge", decoded, corrected)
        board, truth, _ = take(f"{chosen.rig}/board?seed={seed}", PmpPattern(axes=(true.phase_axis,)))
        inside = np.zeros(truth.lit.shape, bool)
        inside[7:-7, 7:-7] = truth.lit[7:-7, 7:-7]
        for name, target in (("corrected", corrected), ("as published", plain)):
            found = solve_hall(target, [Observation(view, true.camera.size, true.projector.size)])
            world, hall = found.extra["world"], found.extra["hall"]
            if true.phase_axis == "y":
                xyz = triangulate_hall(np.array(hall["camera"]), np.array(hall["projector"]), board.rows)
            else:
                xyz = triangulate(found.geometry, columns=board.columns).xyz @ np.array(world["rotation"]).T
                xyz = xyz + world["translation"]
            off = (xyz - (truth.xyz - middle))[inside & np.isfinite(xyz).all(axis=-1)]
            left = found.adjusted.camera_residuals[0]
            print(
                f"{name:13} {len(view.ids)} discs, {np.sqrt((left**2).sum(axis=1).mean()):.3f} px left; board: rms "
                f"{np.sqrt((off[:, 2] ** 2).mean()):.4f} mm, mean {off[:, 2].mean():+.4f} mm",
                flush=True,
            )


def real(chosen):
    folder = Path(chosen.folder)
    corners = np.load(folder / "corners.npz")
    target = parse_target("chessboard:9x13:10")
    names = sorted({name.partition("_")[0] for name in corners})
    count = len(target.points)
    views = [
        View(
            name,
            np.arange(count),
            corners[f"{name}_cam"].astype(np.float64),
            corners[f"{name}_proj"].astype(np.float64),
            np.full((count, 2), 0.1),
            np.zeros((count, 2, 2)),
        )
        for name in names
    ]
    sizes = (1688, 1352), (1824, 1140)
    for rigid in (False, True):
        solution = solve(target, [Observation(view, *sizes) for view in views], SolveOptions(rigid=rigid))
        kinds = solution.adjusted.camera_residuals, solution.adjusted.projector_residuals
        camera, projector = ((np.concatenate(part) ** 2).sum(axis=1).mean() for part in kinds)
        print(
            f"corners given ({'rigid' if rigid else 'sheet fitted'}): camera {np.sqrt(camera):.4f} px, "
            f"projector {np.sqrt(projector):.4f} px, both {np.sqrt((camera + projector) / 2):.4f} px rms"
        )
    own = observe_capture(folder, "images", target)
    if isinstance(own, LeftOut):
        sys.exit(own.reason)
    off = {}
    for name in names:
        distance = np.linalg.norm(own.view.camera[:, None] - corners[f"{name}_cam"][None], axis=-1)
        nearest = distance.argmin(axis=1)
        projector = np.linalg.norm(own.view.projector - corners[f"{name}_proj"][nearest], axis=1)
        off[name] = np.median(distance.min(axis=1)), np.median(projector), np.percentile(projector, 95)
    name = min(off, key=off.get)
    camera, middle, most = off[name]
    print(
        f"from the images ({name}): camera {camera:.3f}, projector {middle:.3f} px median, {most:.3f} px in 95 of 100"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    for name, work in (("poses", poses), ("planes", planes), ("sphere", spheres), ("wedge", wedge), ("real", real)):
        command = commands.add_parser(name)
        command.set_defaults(work=work)
        command.add_argument("--seeds", type=int, default=3 if name == "poses" else 1)
        command.add_argument("--first", type=int, default=0, help="first seed")
        if name == "poses":
            command.add_argument("--rigs", default="casey2011,bench2026")
            command.add_argument("--targets", default="charuco,chessboard")
        elif name == "real":
            command.add_argument("folder")
        else:
            command.add_argument("--rig", default="casey2011")
            command.add_argument("--target", default="charuco")
            if name == "sphere":
                command.add_argument("--shifts", type=int, default=8)
    chosen = parser.parse_args()
    chosen.work(chosen)


if __name__ == "__main__":
    main()
