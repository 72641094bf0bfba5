"""The budget: calibration by random draws, grey levels by decoding them, sums that are sums, and what is unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanner.calibration_spread import LENS_MEMBERS, depth_spread, moved
from scanner.decode import decoder_for
from scanner.patterns import (
    CameraFormat,
    CompositePattern,
    GrayPattern,
    McpPattern,
    PatternSequence,
    PmpPattern,
    ProjectorSize,
)
from scanner.patterns.sequence import Precorrection
from scanner.scan import build_scan
from scanner.triangulation import triangulate
from scanner.uncertainty import Budget, Contribution, budget_of, grey_level_px

NAMES = [f"{part}.{name}" for part in ("camera", "projector") for name in LENS_MEMBERS]
NAMES += [f"{part}.{axis}" for part in ("rotation", "translation") for axis in "xyz"]
SIGMAS = np.array([1.2, 1.2, 1.5, 1.5, 2e-3, 5e-3, 2e-4, 2e-4, 0] * 2 + [5e-4] * 3 + [0.3, 0.3, 0.5])
SEQUENCE = PatternSequence(ProjectorSize(400, 300), PmpPattern(("y",), (1.0, 8.0, 24.0), (4, 4, 4)))
LIGHT = {"y": {"harmonics": [{"frequency": 24.0, "ripple_px": 0.04}]}}
UNWRAPPING = {"y": {"ripple": {"px": 0.02}}}


def matrix():
    """A covariance in which focal lengths and depths of the rig go together."""
    correlated = np.eye(len(NAMES))
    for one, two in (("camera.fx", "camera.fy"), ("projector.fy", "translation.z"), ("rotation.x", "projector.cy")):
        correlated[NAMES.index(one), NAMES.index(two)] = correlated[NAMES.index(two), NAMES.index(one)] = 0.8
    return correlated * SIGMAS[:, None] * SIGMAS


@pytest.fixture
def scene(rig_of, scene_with):
    return scene_with(rig_of("y", camera_k=(-0.08, 0.02, 0, 0, 0)), lambda x, y: 700 + 60 * x + 20 * np.sin(9 * y))


def scan_of(scene, **details):
    decoded = replace(scene.decoded(noise_px=0.05), details=details)
    return build_scan(decoded, scene.calibration)


def with_covariance(calibration, **extra):
    content = {"parameters": NAMES, "matrix": matrix().tolist()}
    return replace(calibration, extra={"covariance": content, **extra})


def test_a_calibrations_covariance_spreads_depth_as_random_rigs_do(scene):
    known = with_covariance(scene.calibration)
    stated = depth_spread(known, scan_of(scene), "y")
    random, depths = np.random.default_rng(1), []
    values = np.full(scene.truth.rows.shape, np.nan, np.float32)
    values[::16, ::16] = np.where(scene.lit, scene.truth.rows, np.nan)[::16, ::16]
    for draw in random.multivariate_normal(np.zeros(len(NAMES)), matrix(), 150, method="svd"):
        rig = scene.calibration
        for name, step in zip(NAMES, draw, strict=True):
            rig = moved(rig, name, step)
        depths.append(triangulate(rig, rows=values).xyz[::16, ::16, 2])
    spread = np.sqrt(np.nanmean(np.var(depths, axis=0, ddof=1)))
    assert stated == pytest.approx(spread, rel=0.2)


@pytest.mark.parametrize(
    "covariance",
    [None, {"matrix": [[1.0]]}, {"parameters": ["camera.fx"], "matrix": [[1.0, 0.0]]},
     {"parameters": ["camera.gain"], "matrix": [[1.0]]}, {"parameters": ["camera.fx"], "matrix": [["a"]]}],
)  # fmt: skip
def test_without_a_usable_covariance_it_is_unknown(scene, covariance):
    rig = replace(scene.calibration, extra={"covariance": covariance})
    found = budget_of(scan_of(scene), rig, SEQUENCE, 0.0)
    assert found is not None
    assert "calibration" in found.unknown
    assert np.isfinite(found.combined_mm)


def drawn(sigmas, noise, seed=0):
    """95th percentile of the magnitude of errors of these sigmas, by drawing them."""
    return np.percentile(np.abs(sigmas * noise(np.random.default_rng(seed), sigmas.size)), 95)


@pytest.mark.parametrize("systematic", [0.0, 0.3])
def test_what_holds_for_95_of_100_points_is_not_of_the_median_one(systematic):
    sigmas = np.concatenate([np.full(30_000, 0.1), np.full(10_000, 1.0)])
    causes = (Contribution("noise", "random", 0.1, 0.1, ""), Contribution("sync", "systematic", 0.1, systematic, ""))
    budget = Budget(700.0, causes, sigmas.astype(np.float32))
    both = np.hypot(sigmas, systematic)
    assert budget.within_mm == pytest.approx(drawn(both, lambda rng, n: rng.normal(size=n)), rel=0.03)
    assert budget.within_mm > 2 * 2 * budget.combined_mm or systematic


def test_cells_of_a_code_are_rectangular():
    sigmas = np.full(40_000, 0.5, np.float32)
    budget = Budget(700.0, (Contribution("quantisation", "systematic", 0.5, 0.5, ""),), sigmas)
    assert budget.within_mm == pytest.approx(0.95 * np.sqrt(3) * 0.5, rel=1e-3)
    assert budget.within_mm == pytest.approx(drawn(sigmas, lambda rng, n: rng.uniform(-1, 1, n) * np.sqrt(3)), rel=0.02)
    # 95 of 100 of a rectangular error: less than twice its sigma.
    assert budget.as_dict()["expanded_mm"] == pytest.approx(0.5 * 0.95 * 3**0.5)
    noisy = Budget(700.0, (*budget.contributions, Contribution("calibration", "systematic", 0.5, 0.5, "")), sigmas)
    assert noisy.coverage_factor == 2


def test_sums_are_those_of_what_is_known(scene):
    rig = with_covariance(scene.calibration, scale="unverified")
    found = budget_of(scan_of(scene, light=LIGHT, unwrapping=UNWRAPPING), rig, SEQUENCE, 0.1)
    assert found is not None
    told = found.as_dict()
    by_name = {c["name"]: c for c in told["contributions"]}
    assert list(by_name) == ["noise", "calibration", "response", "grey levels", "sync"]
    assert by_name["noise"]["px"] == pytest.approx(0.05, rel=0.01)
    assert [c["kind"] for c in told["contributions"]] == ["random", *["systematic"] * 4]
    assert by_name["response"]["px"] == 0.04
    per_px = by_name["noise"]["mm"] / by_name["noise"]["px"]
    assert by_name["response"]["mm"] == pytest.approx(0.04 * per_px, rel=0.02)
    # A tenth of the next shift's light: a fortieth of a period of 300 / 24 px, rectangular.
    assert by_name["sync"]["px"] == pytest.approx(0.1 / 4 * 300 / 24 / np.sqrt(3))
    assert "absolute scale is unverified" in by_name["calibration"]["says"]
    systematic = np.sqrt(sum(by_name[n]["mm"] ** 2 for n in ("calibration", "response", "grey levels", "sync")))
    assert told["systematic_mm"] == pytest.approx(systematic)
    assert told["random_mm"] == pytest.approx(by_name["noise"]["mm"])
    assert told["expanded_mm"] == pytest.approx(2 * np.hypot(told["random_mm"], systematic))
    assert told["combined_mm"] ** 2 == pytest.approx(sum(c["mm"] ** 2 for c in told["contributions"]))
    largest = max(told["contributions"], key=lambda c: c["mm"])
    share = (largest["mm"] / told["combined_mm"]) ** 2
    assert told["dominant"] == {"name": largest["name"], "share": pytest.approx(share)}
    assert told["unknown"] == []
    assert told["stated_length"] is None
    stated = with_covariance(scene.calibration, scale={"reference_mm": 240.0, "sigma_mm": 0.05})
    share = budget_of(scan_of(scene, light=LIGHT, unwrapping=UNWRAPPING), stated, SEQUENCE, 0.1).as_dict()[
        "stated_length"
    ]
    assert share["share"] == pytest.approx(min((told["depth_mm"] * 0.05 / 240 / told["combined_mm"]) ** 2, 1))
    assert told["depth_mm"] == pytest.approx(np.nanmedian(scene.truth.xyz[..., 2][scene.lit]), abs=1)


def test_what_cannot_be_told_is_in_no_sum(scene):
    single = replace(SEQUENCE, pattern=PmpPattern(("y",), (1.0,), (4,)))
    found = budget_of(scan_of(scene), scene.calibration, single, None)
    assert found is not None
    assert found.unknown == ("calibration", "response", "sync")
    gray = PatternSequence(ProjectorSize(400, 300), GrayPattern(("y",), 9, 9))
    composite = PatternSequence(SEQUENCE.projector, CompositePattern("y", (20.0, 40.0, 60.0, 80.0)))
    stripes = PatternSequence(SEQUENCE.projector, McpPattern(bits=2, carriers=(20.0, 34.0), codes=(0, 1, 2, 3)))
    for sequence, name in ((composite, "method"), (stripes, "print")):
        assert name in budget_of(scan_of(scene), scene.calibration, sequence, 0.0).unknown
    found = budget_of(scan_of(scene), scene.calibration, gray, 0.2)
    assert found is not None
    assert [c.name for c in found.contributions] == ["quantisation", "calibration", "sync"]
    assert found.of("random") == 0, "rounding to the cells of a code is no noise"
    assert found.of("systematic") > 0
    assert found.unknown == ("calibration", "sync")
    nothing = replace(scan_of(scene), xyz=None)
    assert budget_of(nothing, scene.calibration, gray, 0.0) is None


@pytest.mark.parametrize("gamma", [None, 2.2])
@pytest.mark.parametrize("shifts", [3, 8])
def test_grey_levels_shift_phases_as_decoding_the_images_shows(gamma, shifts):
    """A camera without noise that sees each projector pixel alone, and grey levels 250 times as fine as shown."""
    size = ProjectorSize(64, 512)
    correction = None if gamma is None else Precorrection(gamma=gamma)
    sequence = PatternSequence(size, PmpPattern(("y",), (1.0, 30.5), (shifts, shifts)), precorrection=correction)
    camera = CameraFormat(64, 512, 16)
    decoder = decoder_for(sequence, camera)
    for position in range(len(sequence)):
        light = (sequence.image(position) / 255.0) ** (gamma or 1.0)
        decoder.add(position, np.rint(1000 + 60_000 * light).astype(np.uint16))
    error = decoder.finish().rows - np.arange(512)[:, None]
    assert grey_level_px(sequence, "y") == pytest.approx(np.sqrt(np.nanmean(error**2)), rel=0.1)
