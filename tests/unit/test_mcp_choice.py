"""The MCP pattern chosen for a projector and a camera."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from drivers.simulated.rigs import rig
from scanner.clock import MonotonicClock
from scanner.errors import DecodeError
from scanner.patterns import ProjectorSize
from scanner.patterns.mcp import McpPattern
from scanner.patterns.mcp_choice import choose_mcp
from scanner.wire import ScanStart
from service.cli import main
from service.config import load_rig
from service.rig_patterns import known_of
from service.scan_patterns import METHODS, pattern_for
from service.scan_setup import open_rig, sequence_for

SIZES = [(1152, 864), (1920, 1080), (912, 1140), (1024, 768), (320, 240), (3840, 2160)]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("scale", [0.5, 1.0, 1.5, 3.0])
def test_whatever_is_chosen_is_a_pattern_of_that_projector(size, axis, scale):
    projector = ProjectorSize(*size)
    choice = choose_mcp(projector, axis, (scale, scale))
    choice.pattern.validate(projector)
    across = projector.along("x" if axis == "y" else "y")
    finest = across / max(choice.pattern.carriers)
    assert finest * scale > 2 / 0.58, "a carrier near the camera's Nyquist frequency"
    assert choice.why.keys() == {"axis", "bits", "carriers", "profile", "codes"}


def test_a_finer_camera_gets_finer_carriers_and_never_coarser_ones():
    carriers = [max(choose_mcp(ProjectorSize(1920, 1080), "x", (s, s)).pattern.carriers) for s in (0.3, 0.6, 1, 2, 5)]
    assert carriers == sorted(carriers)


def test_stripes_that_the_camera_cannot_tell_apart_become_fewer():
    projector = ProjectorSize(1152, 864)
    bits = [choose_mcp(projector, "y", (1.0, scale)).pattern.bits for scale in (1.0, 0.2, 0.1)]
    assert bits == [4, 3, 2]


def test_pixels_half_as_wide_as_high_have_twice_the_blur_across():
    # Mirrors on their corners: rows half as high as columns are wide, carriers along the rows' count.
    projector, scale = ProjectorSize(912, 1140), 2.0
    square, choice = (choose_mcp(projector, "x", (along, 1.0)) for along in (1.0, scale))
    # The same lens: cycles fall as its spread along the carriers, sqrt(2^2 + 1) for sqrt(1 + 1), grows.
    assert max(choice.pattern.carriers) == pytest.approx(max(square.pattern.carriers) * np.sqrt(2 / 5), rel=0.01)
    assert "2.0 times as long" in choice.why["carriers"]
    assert "times as long" not in square.why["carriers"]


def test_the_reference_rigs_get_what_the_default_was_found_to_be():
    calibration = rig("casey2011").calibration
    choice = choose_mcp(ProjectorSize(*calibration.projector.size), "y", calibration.camera_scale)
    assert choice.pattern == McpPattern()


def test_too_coarse_is_said():
    with pytest.raises(DecodeError, match="too coarse for mcp") as caught:
        choose_mcp(ProjectorSize(64, 48), "y")
    assert "pmp" in caught.value.hint


def test_the_cameras_scale_is_that_of_a_wall_where_the_axes_meet(rig_of):
    """Camera 620 px at 700 mm; projector 700 and 690 px at 728 mm, turned by 16 degrees about y."""
    turned = np.cos(np.arctan2(200, 700))
    camera, projector = 620 / 700, np.array([700, 690]) / np.hypot(200, 700)
    scale = rig_of("x").camera_scale
    assert scale[0] == pytest.approx(camera / (projector[0] * turned), rel=0.01)
    assert scale[1] == pytest.approx(camera / projector[1], rel=0.01)


def test_the_choice_for_a_rig_is_written_and_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["patterns", "mcp", "-o", str(tmp_path / "p"), "--for", "simulated:quick/board", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["projector"] == {"width": 320, "height": 240}
    assert "camera pixels" in told["why"]["carriers"]
    assert json.loads((tmp_path / "p" / "pattern.json").read_text())["pattern"] == told["pattern"]


@pytest.fixture(scope="module")
def opened():
    config = load_rig("simulated:quick/board").model_dump(mode="json")
    rig_opened = open_rig(config, MonotonicClock())
    yield rig_opened
    rig_opened.close()


@pytest.mark.parametrize("method", METHODS)
def test_a_scan_projects_what_patterns_for_the_rig_writes(method, opened, tmp_path, capsys):
    words = ["patterns", method, "-o", str(tmp_path / "p"), "--for", "simulated:quick/board", "--bracketed", "--json"]
    assert main(words) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["pattern"] == json.loads(json.dumps(sequence_for(opened, ScanStart("a", method)).describe()))
    assert told["pattern"]["precorrection"] is not None
    assert f"{told['pattern']['precorrection']['gamma']:g}" in told["why"]["gamma"]


def test_a_rig_without_a_calibration_is_chosen_for_by_its_devices_sizes():
    projector = ProjectorSize(1920, 1080)
    coarse, fine = (known_of("x", None, projector, size) for size in ((640, 480), (3840, 2160)))
    assert (coarse.axis, coarse.precorrection) == ("x", None)
    least, most = (max(pattern_for("mcp", {}, "x", projector, known.camera_scale).carriers) for known in (coarse, fine))
    assert 1080 / least * coarse.camera_scale[1] > 2 / 0.58
    assert least < most
