"""How sure a verification's figures are: a baseline that scales everything, noise that scatters it, what is unknown."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from scanner.calibration import figure_spread
from scanner.calibration.beyond_noise import beyond_noise
from scanner.calibration.detection import Detection
from scanner.calibration.features import spread
from scanner.calibration.figure_spread import BOARD, SPHERE, Rig, Spread, spread_of_figures, spread_of_length
from scanner.calibration.repeat_spread import half_width
from scanner.calibration.targets import parse_target
from scanner.calibration.verification import (
    FeaturePoints,
    board_figures,
    sphere_figures,
)
from scanner.calibration.verified import Wanted, verified
from scanner.capture import CaptureHeader
from scanner.geometry import calibration_from_dict
from scanner.patterns import CameraFormat, McpPattern, PatternSequence, ProjectorSize
from scanner.scan import Scan, load_scan
from service.cli import main

WIDTH, HEIGHT, RADIUS = 160, 120, 60.0
BASELINE = 150.0
SHARE = 1e-3
"""1-sigma of the baseline: of all lengths, too"""
NOISE_MM = 0.05


def rig(**extra):
    """A projector 150 mm above the camera; its covariance knows an error of the baseline alone."""
    lens = {
        "size": [WIDTH, HEIGHT],
        "matrix": [[300, 0, 80], [0, 300, 60], [0, 0, 1]],
        "distortion": [-0.05, 0, 0, 0, 0],
    }
    covariance = {"parameters": ["camera.k1", "translation.y"], "matrix": [[0.0, 0.0], [0.0, (SHARE * BASELINE) ** 2]]}
    turn = cv2.Rodrigues(np.array([0.3, 0.0, 0.0]))[0]
    return {
        "format": "fringed-calibration", "version": 1, "id": "made up", "camera": lens, "projector": lens,
        "rotation": turn.tolist(), "translation": [0, BASELINE, 0], "covariance": covariance, **extra,
    }  # fmt: skip


def rays():
    calibration = calibration_from_dict(rig())
    plane = calibration.camera.normalised(calibration.camera.pixel_grid())
    return np.concatenate([plane, np.ones((HEIGHT, WIDTH, 1))], axis=-1)


def ball(seed=0, noise=NOISE_MM):
    """(H, W, 3) mm: a ball at 500 mm, nothing around it, noise along the rays; and the noise's sigma (H, W)."""
    along, centre = rays(), np.array([0.0, 0.0, 500.0])
    b, a = along @ centre, (along**2).sum(axis=-1)
    root = b**2 - a * (centre @ centre - RADIUS**2)
    z = (b - np.sqrt(np.where(root > 0.3 * RADIUS**2 * a, root, np.nan))) / a
    z = z + np.random.default_rng(seed).normal(0, noise, z.shape)
    return along * z[..., None], np.full(z.shape, noise, np.float32)


def wall(seed=0):
    """(H, W, 3) mm: a wall at 500 mm."""
    z = 500 + np.random.default_rng(seed).normal(0, NOISE_MM, (HEIGHT, WIDTH))
    return rays() * z[..., None]


@pytest.fixture(autouse=True)
def _fewer_draws(monkeypatch):
    monkeypatch.setattr(figure_spread, "DRAWS", 100)
    monkeypatch.setattr(figure_spread, "POINTS", 800)


def test_a_baseline_too_long_makes_a_ball_too_large_and_no_less_round():
    found = spread_of_figures(ball_alone(0), WIDTH, SPHERE, Rig(calibration_from_dict(rig()), "y"))
    assert found["diameter_mm"].calibration == pytest.approx(SHARE * 2 * RADIUS, rel=0.03)
    assert found["form_mm"].calibration < 2 * SHARE * 6 * NOISE_MM
    both = np.hypot(found["diameter_mm"].random, found["diameter_mm"].calibration)
    assert found["diameter_mm"].expanded == pytest.approx(2 * both)


def ball_alone(seed):
    """All points of a ball."""
    flat = ball(seed)[0].reshape(-1, 3)
    at = np.flatnonzero(np.isfinite(flat[:, 2]))
    return FeaturePoints(flat[at], at, 1.0)


def test_the_random_part_is_what_other_noise_makes_of_it():
    clouds = [ball_alone(seed) for seed in range(12)]
    stated = spread_of_figures(clouds[0], WIDTH, SPHERE, None)
    for name in ("diameter_mm", "form_mm"):
        seen = np.std([sphere_figures(on.points)[name] for on in clouds], ddof=1)
        # A deviation from twelve is good to 21 %, the stated one to 7 %: 2.5 sigma of both.
        assert stated[name].random == pytest.approx(seen, rel=0.55)
        assert stated[name].calibration is None
        assert stated[name].expanded is None


@pytest.mark.parametrize("outward_mm", [0.0, 0.3])
def test_a_rim_that_is_off_is_in_the_diameters_uncertainty(outward_mm):
    """Points at more than 75 degrees lie outward: U has what the diameter is off by them, and next to nothing else."""
    generator = np.random.default_rng(3)
    facing = generator.uniform(np.cos(np.radians(85)), 1, 20_000)
    turn = generator.uniform(0, 2 * np.pi, facing.size)
    across = np.sqrt(1 - facing**2)
    normals = np.stack((across * np.cos(turn), across * np.sin(turn), -facing), axis=1)
    off = generator.normal(0, 0.01, facing.size) + np.where(facing < np.cos(np.radians(75)), outward_mm, 0.0)
    points = np.array([0.0, 0.0, 5e4]) + (RADIUS + off)[:, None] * normals
    found = spread_of_figures(FeaturePoints(points, np.zeros(len(points), np.intp), 1.0), WIDTH, SPHERE, None)
    error = sphere_figures(points)["diameter_mm"] - 2 * RADIUS
    assert abs(error) <= found["diameter_mm"].rim + 2 * found["diameter_mm"].random
    assert found["diameter_mm"].rim < 1.5 * abs(error) + 0.001
    assert {name for name, spread in found.items() if spread.rim} == {"diameter_mm"}


def test_the_rim_comes_on_top_of_u():
    spread = Spread(0.003, 0.002, rim=0.01)
    assert spread.expanded == pytest.approx(2 * np.hypot(0.003, 0.002) + 0.01)
    assert spread.as_dict()["rim"] == 0.01
    assert "rim" not in Spread(0.003, 0.002).as_dict()


def bending_rig():
    """The rig of `rig`, whose lenses' first coefficients are known to 0.004 only: a wall bends."""
    names, shares = ["camera.k1", "projector.k1", "translation.y"], [0.004, 0.004, SHARE * BASELINE]
    return calibration_from_dict(rig(covariance={"parameters": names, "matrix": np.diag(np.square(shares)).tolist()}))


def covered(feature, truth, at, names, bow_mm=0.0, draws=30):
    """Of each figure the share of draws, of rigs and noise, whose U contains what the true rig shows."""
    of_rig, generator = Rig(bending_rig(), "y"), np.random.default_rng(11)
    moves = of_rig.spread(truth, at // WIDTH, at % WIDTH).draws(draws, 7)
    along = truth / truth[:, 2:]
    away = ((truth - truth.mean(axis=0)) ** 2).sum(axis=1)
    shape = truth + along * (bow_mm * away / away.max())[:, None]

    def seen():
        return shape + along * generator.normal(0, NOISE_MM, len(shape))[:, None]

    true = [feature.figures(seen()) for _ in range(20)]
    inside = dict.fromkeys(names, 0.0)
    for move in moves:
        cloud = seen() + move
        found = feature.figures(cloud)
        stated = spread_of_figures(FeaturePoints(cloud, at, 1.0), WIDTH, feature, of_rig)
        for name in names:
            wanted = np.mean([one[name] for one in true])
            inside[name] += (abs(found[name] - wanted) < stated[name].expanded) / draws
    return inside


@pytest.mark.parametrize("bow_mm", [0.0, 0.4])
def test_as_many_boards_as_u_says_are_within_it(monkeypatch, bow_mm):
    """A calibration that is off makes a board less flat, never flatter: twice its own deviation would be too wide."""
    monkeypatch.setattr(figure_spread, "DRAWS", 60)  # good to 12 %
    at = np.flatnonzero(np.ones(WIDTH * HEIGHT))[::29]
    inside = covered(BOARD, rays().reshape(-1, 3)[at] * 500, at, ("flatness_mm", "distance_mm", "bow_mm"), bow_mm)
    # Of thirty draws, with 95.45 % each: one in a thousand has fewer than 25 within.
    assert min(inside.values()) >= 0.83, inside


def test_u_of_flatness_is_what_calibrations_scatter_it_by():
    at = np.flatnonzero(np.ones(WIDTH * HEIGHT))[::17]
    of_rig, truth = Rig(bending_rig(), "y"), rays().reshape(-1, 3)[at] * 500
    moves = of_rig.spread(truth, at // WIDTH, at % WIDTH).draws(2000, 7)
    generator, along = np.random.default_rng(12), truth / truth[:, 2:]

    def noisy(points):
        return points + along * generator.normal(0, NOISE_MM, len(at))[:, None]

    clouds = [noisy(truth + move) for move in moves]
    flat = np.mean([board_figures(noisy(truth))["flatness_mm"] for _ in range(20)])
    seen = np.quantile([abs(board_figures(one)["flatness_mm"] - flat) for one in clouds], 0.9545)
    on = [FeaturePoints(one, at, 1.0) for one in clouds[:12]]
    stated = [spread_of_figures(one, WIDTH, BOARD, of_rig)["flatness_mm"].expanded for one in on]
    # The quantile of 2000 is good to 3 %, the median of twelve to 4.
    assert np.median(stated) == pytest.approx(seen, rel=0.12)


def test_u_of_flatness_is_worth_its_digits():
    at = np.arange(WIDTH * HEIGHT)
    on = [FeaturePoints(wall(seed).reshape(-1, 3), at, 1.0) for seed in range(8)]
    stated = [spread_of_figures(one, WIDTH, BOARD, Rig(bending_rig(), "y")) for one in on]
    for name, share in (("flatness_mm", 0.05), ("rms_mm", 0.03), ("bow_mm", 0.01)):
        values = [one[name].expanded for one in stated]
        assert np.std(values) < share * np.mean(values), name


def test_width_of_points_is_as_sure_as_order_statistics_have_it():
    generator = np.random.default_rng(13)
    normals = [generator.normal(size=4000) for _ in range(150)]
    for left_out in (0.003, 0.05):
        seen = np.std([spread(one, left_out) for one in normals], ddof=1)
        stated = [figure_spread._of_width(one, left_out) for one in normals[:20]]
        # 150 give a deviation good to 6 %, the slope by differences is a few per cent too steep.
        assert np.mean(stated) == pytest.approx(seen, rel=0.2)


@pytest.mark.parametrize(("scans", "common"), [(3, 0.0), (6, 0.0), (6, 10.0), (20, 1.0)])
def test_repeatability_is_as_sure_as_its_pixels_or_its_scans(scans, common):
    generator = np.random.default_rng(14)
    noise = np.exp(generator.normal(0, 0.4, 1500))
    true, inside, widths = np.sqrt(np.mean(noise**2) + common**2), 0, []
    for _ in range(60):
        values = noise * generator.normal(size=(scans, 1500)) + common * generator.normal(size=(scans, 1))
        deviation = np.sqrt(values.var(axis=0, ddof=1).mean())
        widths.append(half_width(values))
        inside += abs(deviation - true) < widths[-1]
    # Of sixty, with 95 % each: two in a thousand have fewer than 52 within.
    assert inside >= 52
    # Pixels' own noise: known by all of them; what is common: by the number of scans.
    assert np.median(widths) / true < 0.05 if common == 0 else np.median(widths) / true > 0.1
    assert half_width(np.ones((2, 1500))) is None
    assert half_width(np.ones((4, 1500))) == 0.0


def noisy_wall(seed, tails):
    """Deviations of a wall, whose noise grows with the column, or has three sizes by the row's phase."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    sigma = NOISE_MM * np.where(v % 3, 1.0, 0.2) if tails else NOISE_MM * (1 + u / WIDTH)
    return np.random.default_rng(seed).normal(size=v.shape) * sigma


@pytest.mark.parametrize("left_out", [0.003, 0.05])
@pytest.mark.parametrize("tails", [False, True])
def test_what_is_beyond_noise_is_as_sure_as_it_says_and_noise_too(tails, left_out):
    at = np.arange(WIDTH * HEIGHT)
    clouds = [noisy_wall(seed, tails).reshape(-1) for seed in range(60)]
    found = [beyond_noise(off, at, (HEIGHT, WIDTH), left_out) for off in clouds]
    true = np.mean([spread(off, left_out) for off in clouds])
    assert np.mean([one.noise_mm for one in found]) == pytest.approx(true, rel=0.006)
    # Of 60 that hold 95.45 % fewer than 53 do in one of a hundred such tests.
    assert np.mean([abs(one.noise_mm - true) < 2 * one.noise_random for one in found]) > 0.88
    assert np.mean([abs(one.squared) < one.unsure for one in found]) > 0.88
    assert np.std([one.squared for one in found]) == pytest.approx(
        np.median([one.unsure for one in found]) / 2, rel=0.4
    )


@pytest.mark.parametrize("form_mm", [0.0, 0.15, 0.4])
@pytest.mark.parametrize("ripple_mm", [None, 0.03])
def test_a_balls_lobes_are_beyond_noise_and_ripple_and_a_perfect_one_has_none(tmp_path, form_mm, ripple_mm, capsys):
    """Whatever sigmas are stated; a ripple of the scan's budget may be all that there is."""
    points, plain = ball()
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    lobes = np.cos(3 * np.arctan2(v - 60, u - 80)) * np.minimum(np.hypot(v - 60, u - 80) / 20, 1)
    folder = tmp_path / "a"
    save(folder, points * (1 + form_mm / 2 / 500 * lobes)[..., None], 1.3 * plain, "made up")
    report = json.loads((folder / "report.json").read_text())
    if ripple_mm is not None:
        parts = [{"name": "grey levels", "kind": "systematic", "mm": ripple_mm}]
        report["uncertainty"] = {"systematic_mm": ripple_mm, "contributions": parts, "unknown": []}
        (folder / "report.json").write_text(json.dumps(report))
    found = verified(folder, load_scan(folder), Wanted(sphere_mm=2 * RADIUS))["sphere"]
    noise = sphere_figures(ball_alone(0).points)["form_mm"]
    assert found["noise_mm"] == pytest.approx(noise, rel=0.04)
    beyond = found["beyond"]["form_mm"]
    assert beyond["least_mm"] <= beyond["mm"] <= beyond["most_mm"]
    assert (beyond["least_mm"] > 0) == (form_mm > (0 if ripple_mm is None else 0.15))
    unsure = found["uncertainty"]["noise_mm"]["expanded"]
    assert unsure > 0.005 if ripple_mm is None else unsure > 0.03
    assert main(["calibrate", "verify", str(folder), "--sphere", str(2 * RADIUS)]) == 0
    said = capsys.readouterr().out
    form = r"beyond it 0\.\d+ \+- 0\.\d+:" if beyond["least_mm"] > 0 else r"beyond it 0\.\d+ at most:"
    assert re.search(rf"a perfect sphere has 0\.\d+ \+- 0\.\d+ by noise, {form}", said)
    # Of codes and stripes neighbours err alike.
    (folder / "report.json").write_text(json.dumps({**report, "decoder": {"method": "gray"}}))
    coded = verified(folder, load_scan(folder), Wanted(sphere_mm=2 * RADIUS))["sphere"]
    assert coded["noise_mm"] is None
    assert coded["beyond"] == {}


def test_length_of_a_target_is_as_sure_as_the_baseline_and_the_places_of_its_marks():
    target = parse_target("chessboard:9x6:12")
    calibration = calibration_from_dict(rig())
    pixels = calibration.camera.project(target.points + np.array([0.0, 0.0, 500.0]))
    off = np.random.default_rng(3).normal(0, 0.05, pixels.shape)
    seen = Detection(np.arange(len(pixels)), pixels + off, np.full(len(pixels), 7.0))
    found = spread_of_length(seen, target, wall().astype(np.float32), Rig(calibration, "y"))
    assert found.calibration == pytest.approx(SHARE * 96, rel=0.02)
    assert found.random == pytest.approx(np.sqrt(2) * 0.05 * 500 / 300, rel=0.3)
    few = Detection(seen.ids[[0, 1, 8]], seen.points[[0, 1, 8]], seen.spacing[:3])
    assert spread_of_length(few, target, wall().astype(np.float32), None).random is None


def save(folder: Path, xyz, sigma, calibration: str) -> None:
    """A scan of this rig, as `fringed scan` leaves it, with its capture's calibration beside it."""
    made = calibration_from_dict(rig())
    rows = made.projector.project(made.to_projector(xyz))[..., 1].astype(np.float32)
    plain = np.full(rows.shape, 100, np.float32)
    scan = Scan(
        rows, None, plain * 1e-4, None, plain, plain, plain, np.zeros(rows.shape, np.uint8), xyz.astype(np.float32),
        sigma, report={"format": "fringed-report", "version": 1, "rig": {"calibration": calibration},
        "decoder": {"method": "pmp"}},
    )  # fmt: skip
    (folder / "capture").mkdir(parents=True)
    np.savez(folder / "scan.npz", **scan.arrays())
    (folder / "report.json").write_text(json.dumps(scan.report))
    sequence = PatternSequence(
        ProjectorSize(WIDTH, HEIGHT), McpPattern(bits=2, carriers=(20.0, 34.0), codes=(0, 1, 2, 3))
    )
    header = CaptureHeader(sequence, CameraFormat(WIDTH, HEIGHT, 8), frames=("0.png",), calibration="calibration.json")
    (folder / "capture" / "capture.json").write_text(json.dumps(header.as_dict()))
    scale = {"reference_mm": 100.0, "sigma_mm": 100 * SHARE}
    (folder / "capture" / "calibration.json").write_text(json.dumps(rig(scale=scale)))


def test_verify_takes_the_calibration_that_made_the_scan_and_no_other(tmp_path, capsys):
    save(tmp_path / "a", *ball(), "made up")
    ask = ["calibrate", "verify", str(tmp_path / "a"), "--sphere", "119.5", "--tolerance", "0.6"]
    assert main([*ask, "--json"]) == 0
    shown = capsys.readouterr()
    found = json.loads(shown.out)["scans"][0]
    assert found["unknown"] is None
    unsure = found["sphere"]["uncertainty"]["size_mm"]
    assert unsure["expanded"] == pytest.approx(2 * SHARE * 120, rel=0.2)
    assert found["sphere"]["size_mm"] == pytest.approx(0.5, abs=0.03)
    assert "with its expanded uncertainty (k = 2), 0.7" in shown.err
    assert shown.err.rstrip().endswith("it is not")
    of_budget = [
        {"name": "calibration", "kind": "systematic", "mm": 0.2809},
        {"name": "response", "kind": "systematic", "mm": 0.016},
        {"name": "sync", "kind": "systematic", "mm": None},
    ]
    report = tmp_path / "a" / "report.json"
    budget = {"systematic_mm": 0.2813, "contributions": of_budget, "unknown": ["sync"]}
    report.write_text(json.dumps({**json.loads(report.read_text()), "uncertainty": budget}))
    assert main(ask) == 0
    said, noted = capsys.readouterr()
    assert "needs a covariance" not in noted
    assert "note: the stated length 100.00 +- 0.20 mm (k = 2) dominates, with " in noted
    assert re.search(r"\b0\.\d\d \+- 0\.2\d\b", said), "value and U end at one place"
    assert re.search(
        r"probing form PF +0\.\d+ \+- 0\.\d+ mm, VDI/VDE 2634-2, 99.7 % of the points; a perfect sphere", said
    )
    assert re.search(
        r"form dispersion +0\.\d+ \+- 0\.\d+ mm, ISO 10360-13, 95 % of the points; a perfect sphere has", said
    )
    # U contains the calibration: only the others are said to be in none of the figures.
    assert "at least +-0.032 mm of depth (k = 2) besides the calibration, and what is unknown (sync); in none" in said
    save(tmp_path / "b", *ball(), "another")
    # What `fringed decode --calibration` leaves beside a scan is its calibration, whatever its capture keeps.
    beside = tmp_path / "b" / "calibration.json"
    beside.write_text(json.dumps(rig(id="another")))
    assert main(["calibrate", "verify", str(tmp_path / "b"), "--sphere", "119.5"]) == 0
    assert "expanded uncertainty, k = 2: the calibration's covariance" in capsys.readouterr().out
    beside.unlink()
    without, other, true = (tmp_path / f"{name}.json" for name in ("without", "other", "true"))
    without.write_text(json.dumps(rig(covariance=None)))
    true.write_text(json.dumps(rig(covariance=None, id="simulated-casey2011")))
    other.write_text(json.dumps(rig(translation=[0, 140, 0])))
    for options, why in (
        ([], "no calibration of the name that its report has"),
        (["--calibration", str(without)], "the calibration has no covariance;"),
        (["--calibration", str(true)], "the calibration has no covariance (the true one of a simulated rig);"),
        (["--calibration", str(other)], "were not made by calibration made up"),
    ):
        assert main(["calibrate", "verify", str(tmp_path / "b"), "--sphere", "119.5", *options]) == 0
        said = capsys.readouterr().out
        assert "+- unknown" in said
        assert why in said
