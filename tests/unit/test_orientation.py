"""Maps that run against the rig's geometry are refused; sound ones never are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanner.capture import Capture, CaptureHeader, CaptureWriter, FrameRecord
from scanner.errors import DecodeError
from scanner.geometry import Lens
from scanner.orientation import NOTICEABLE, require_orientation, share_reversed
from scanner.patterns import CameraFormat, PatternSequence, PmpPattern, ProjectorSize
from scanner.reconstruct import reconstruct


def values_of(scene, axis):
    decoded = scene.decoded(noise_px=0.3, axis=axis)
    return decoded.rows if axis == "y" else decoded.columns


def steep(x, y):
    """Waves that turn away from the camera by 60 degrees."""
    return 700 + 12 * np.sin(x * 100) + 12 * np.sin(y * 100)


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("beside", ["x", "y"])
def test_sound_maps_pass_and_mirrored_ones_do_not(rig_of, scene_with, beside, axis):
    scene = scene_with(rig_of(beside), steep)
    values = values_of(scene, axis)
    assert share_reversed(scene.calibration, values, axis) < NOTICEABLE
    assert require_orientation(scene.calibration, values, axis) is None
    size = scene.calibration.projector.size[axis == "y"]
    with pytest.raises(DecodeError, match="contradicts the frames") as caught:
        require_orientation(scene.calibration, size - 1 - values, axis)
    assert "sign" in caught.value.hint
    with pytest.raises(DecodeError):
        require_orientation(scene.calibration, values[::-1] if axis == "y" else values[:, ::-1], axis)


def test_a_projector_that_stands_on_its_head_is_a_rig_like_others(rig_of, scene_with):
    rig = rig_of("y")
    turned = np.diag([-1.0, -1.0, 1.0])
    rig = replace(rig, rotation=turned @ rig.rotation, translation=turned @ rig.translation)
    scene = scene_with(rig, steep)
    assert require_orientation(rig, values_of(scene, "y"), "y") is None


def test_a_part_that_runs_the_wrong_way_is_a_warning(rig_of, scene_with):
    scene = scene_with(rig_of("y"), steep)
    values = values_of(scene, "y")
    values[:, :100] = values[::-1, :100]
    said = require_orientation(scene.calibration, values, "y")
    assert said is not None
    assert "run against the geometry of rig small-y" in said


def test_too_little_says_nothing(rig_of):
    values = np.full((240, 320), np.nan, np.float32)
    values[100:130, 100:130] = 5
    assert share_reversed(rig_of("y"), values, "y") is None


def test_a_description_with_the_wrong_sign_gives_no_cloud(tmp_path, rig_of, scene_with):
    """Frames of one system, described by the sign of another's: they decode, and all of them mirrored."""
    scene = scene_with(rig_of("y"), steep)
    rows, lit = scene.truth.rows, scene.lit
    projector = ProjectorSize(*scene.calibration.projector.size)
    right = PmpPattern(frequencies=(1.0, 8.0), shifts=(4, 4))
    sequence = PatternSequence(projector, right)
    header = CaptureHeader(sequence, CameraFormat(320, 240, 8))
    for name, sign in (("right", -1), ("wrong", 1)):
        pattern = replace(right, sign=sign)
        header = replace(header, sequence=PatternSequence(projector, pattern))
        writer = CaptureWriter(tmp_path / name, header, len(sequence))
        at = np.clip(np.rint(np.where(lit, rows, 0)), 0, projector.height - 1).astype(int)
        for position in range(len(sequence)):
            shown = sequence.image(position)[:, 0].astype(np.float32)[at]
            slot, digest = writer.write(np.where(lit, 10 + 0.8 * shown, 2).astype(np.uint8))
            writer.record(FrameRecord(slot, position, xxh3=digest))
        writer.close("complete")
    assert reconstruct(Capture.open(tmp_path / "right"), scene.calibration).report["warnings"] == []
    with pytest.raises(DecodeError, match="contradicts the frames"):
        reconstruct(Capture.open(tmp_path / "wrong"), scene.calibration)


def test_lenses_count(rig_of, scene_with):
    """Distortion bends the expected directions, not their sense."""
    rig = rig_of("y", camera_k=(-0.1, 0.05, 0, 0, 0), projector_k=(-0.08, 0.02, 0.001, 0, 0))
    assert isinstance(rig.camera, Lens)
    assert require_orientation(rig, values_of(scene_with(rig, steep), "y"), "y") is None
