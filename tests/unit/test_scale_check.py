"""Coordinates twice or half as large as a rig lets them be are refused by name; sound scans never are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanner.capture import Capture, CaptureHeader, CaptureWriter, FrameRecord
from scanner.errors import DecodeError
from scanner.patterns import CameraFormat, GrayPattern, PatternSequence, PmpPattern, ProjectorSize
from scanner.reconstruct import reconstruct
from scanner.scale_check import MOST_LEANING_DEG, read_at, require_scale

PROJECTOR = ProjectorSize(400, 300)
PMP = PatternSequence(PROJECTOR, PmpPattern(("y",), (1.0, 8.0), (4, 4)))


def waves(x, y):
    return 700 + 12 * np.sin(x * 100) + 12 * np.sin(y * 100)


def tilted(degrees, along_x):
    """A plane whose depth changes along one direction, seen at so many degrees."""
    slope = np.tan(np.radians(degrees))
    return lambda x, y: 700 / (1 - slope * (x if along_x else y))


def values_of(scene, axis):
    decoded = scene.decoded(noise_px=0.3, axis=axis)
    return decoded.rows if axis == "y" else decoded.columns


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("degrees", [-55, -30, 0, 30, 55])
@pytest.mark.parametrize("along_x", [False, True])
def test_boards_that_lean_are_sound(rig_of, scene_with, axis, degrees, along_x):
    scene = scene_with(rig_of(axis), tilted(degrees, along_x))
    found = require_scale(scene.calibration, PMP, values_of(scene, axis), 0.3, axis)
    assert found.leaning_deg == pytest.approx(abs(degrees), abs=3)
    assert found.impossible == 0


@pytest.mark.parametrize(("axis", "factor"), [("x", 2.0), ("y", 2.0), ("y", 0.5)])
def test_half_and_twice_the_coordinates_are_refused(rig_of, scene_with, axis, factor):
    scene = scene_with(rig_of(axis), waves)
    size = PROJECTOR.along(axis)
    wrong = (values_of(scene, axis) + 0.5) * factor - 0.5
    wrong[wrong > size - 0.5] = np.nan
    with pytest.raises(DecodeError, match=f"times {1 / factor:g} an ordinary") as caught:
        require_scale(scene.calibration, PMP, wrong, 0.3, axis)
    assert "frequencies (1, 8)" in caught.value.hint
    assert f"{PROJECTOR.width} x {PROJECTOR.height}" in caught.value.hint


def test_frequencies_named_an_octave_too_low_are_refused(rig_of, scene_with):
    """Two periods over the projector that are taken for one: the image falls into two halves of twice the pace."""
    scene = scene_with(rig_of("y"), waves)
    folded = ((values_of(scene, "y") + 0.5) * 2) % PROJECTOR.height - 0.5
    with pytest.raises(DecodeError, match="contradicts the frames"):
        require_scale(scene.calibration, PMP, folded, 0.3, "y")


def test_coarse_cells_do_no_harm(rig_of, scene_with):
    """A code's cells of four pixels: flat steps, and jumps from one to the next."""
    scene = scene_with(rig_of("y"), tilted(30, along_x=True))
    values = values_of(scene, "y")
    coarse = (np.floor((values + 0.5) / 4) + 0.5) * 4 - 0.5
    assert require_scale(scene.calibration, PMP, coarse, 4 / np.sqrt(12), "y").leaning_deg < MOST_LEANING_DEG


def test_what_no_factor_explains_and_what_is_too_little_is_left_alone(rig_of, scene_with):
    scene = scene_with(rig_of("y"), tilted(74, along_x=True))
    assert require_scale(scene.calibration, PMP, values_of(scene, "y"), 0.3, "y").contradicts
    few = np.full((240, 320), np.nan, np.float32)
    few[100:130, 100:130] = values_of(scene, "y")[100:130, 100:130]
    assert read_at(scene.calibration, few, 0.3, "y", 1.0) is None


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        (GrayPattern(("y",), 8, 9, inverse=True), {"code_bits": 10}, r"name pixels beyond the projector's 400 x 300"),
        (GrayPattern(("y",), 8, 10, inverse=True), {"code_bits": 9}, r"times 2 an ordinary scan"),
    ],
)
def test_a_description_of_the_wrong_size_gives_no_cloud(tmp_path, rig_of, scene_with, right, wrong, said):
    scene = scene_with(rig_of("y"), waves)
    rows, lit = scene.truth.rows, scene.lit
    sequence = PatternSequence(PROJECTOR, right)
    at = np.clip(np.rint(np.where(lit, rows, 0)), 0, PROJECTOR.height - 1).astype(int)
    for name, pattern in (("right", right), ("wrong", replace(right, **wrong))):
        header = CaptureHeader(replace(sequence, pattern=pattern), CameraFormat(320, 240, 8))
        writer = CaptureWriter(tmp_path / name, header, len(sequence))
        for position in range(len(sequence)):
            shown = sequence.image(position)[:, 0].astype(np.float32)[at]
            slot, digest = writer.write(np.where(lit, 10 + 0.8 * shown, 2).astype(np.uint8))
            writer.record(FrameRecord(slot, position, xxh3=digest))
        writer.close("complete")
    found = reconstruct(Capture.open(tmp_path / "right"), scene.calibration).report
    assert found["warnings"] == []
    assert found["decoder"]["geometry"]["y"]["leaning_deg"] < 10
    with pytest.raises(DecodeError, match=said) as caught:
        reconstruct(Capture.open(tmp_path / "wrong"), scene.calibration)
    assert f"code_bits ({wrong['code_bits']}" in caught.value.hint
