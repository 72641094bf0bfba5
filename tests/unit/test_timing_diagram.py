"""The timing diagram: valid SVG, every frame in it, also for hundreds; PNG of the same picture."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import pytest

from scanner.capture import Capture, CaptureHeader, CaptureWriter
from scanner.errors import StorageError
from scanner.patterns import McpPattern, PatternSequence
from scanner.sequencer import check_capture, timing_diagram
from scanner.sequencer.timing_diagram import COLOURS, WIDTH
from tests.unit.sequencer_bench import QUICK, Taken, pmp, take

MCP = PatternSequence.bracketed(QUICK, McpPattern(axis="x", carriers=(20.0, 30.0, 40.0, 50.0)))


def captured(folder: Path, taken: Taken) -> Capture:
    plan = taken.acquisition.plan
    header = CaptureHeader(taken.sequence, taken.format, id="test <1>", plan=plan.as_dict(), repeat=plan.repeat)
    writer = CaptureWriter(folder, header, plan.frame_count)
    for record in taken.sink.records:
        if record.slot is not None:
            writer.write(taken.sink.frames[record.slot])
        writer.record(record)
    writer.close("complete")
    return Capture.open(folder)


def test_every_frame_is_drawn_in_the_colour_of_its_verdict(tmp_path: Path) -> None:
    taken = take(pmp(), "camera.drop=7")
    svg = timing_diagram(check_capture(captured(tmp_path / "capture", taken)))
    root = ET.fromstring(svg)  # noqa: S314  (our own output)
    names = {element.tag.rpartition("}")[2] for element in root}
    assert names == {"rect", "line", "text"}
    texts = [element.text for element in root if element.tag.endswith("text")]
    assert {str(p) for p in range(len(taken.sequence))} <= set(texts)
    assert "missing" in texts
    assert "7.1" in texts
    fills = [element.get("fill") for element in root]
    assert fills.count(COLOURS["proved"]) >= len(taken.sequence)
    tips = [element[0].text for element in root if len(element)]
    assert any(tip and tip.startswith("frame 5, slot 5") and "proved" in tip for tip in tips)


def test_png_shows_the_same(tmp_path: Path) -> None:
    check = check_capture(captured(tmp_path / "capture", take(pmp())))
    picture = cv2.imdecode(np.frombuffer(timing_diagram(check, "png"), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.shape[1] == WIDTH
    with pytest.raises(StorageError, match="svg or png"):
        timing_diagram(check, "bmp")


def test_hundreds_of_static_frames_fit(tmp_path: Path) -> None:
    from scanner.sequencer import Rig, acquire  # noqa: PLC0415
    from tests.unit.test_latency import DEVICE, VirtualClock, open_camera, open_projector  # noqa: PLC0415

    clock = VirtualClock()
    projector, camera = open_projector("simulated", DEVICE, {}, clock), open_camera("simulated", DEVICE, {}, clock)
    rig = Rig(projector, camera)
    plan = rig.plan(MCP, repeat=200)
    caps = camera.capabilities
    taken = take(MCP)
    writer = CaptureWriter(
        tmp_path / "series", CaptureHeader(MCP, taken.format, repeat=200, plan=plan.as_dict()), plan.frame_count
    )
    acquisition = acquire(rig, plan, MCP, writer, clock)
    writer.close("complete")
    camera.close()
    projector.close()
    assert caps.width == taken.format.width
    assert acquisition.report()["verdicts"]["proved"] == 200
    check = check_capture(Capture.open(tmp_path / "series")).raise_if_out_of_step()
    root = ET.fromstring(timing_diagram(check))  # noqa: S314
    assert 13 * 100 < float(root.get("height") or 0) < 2500


def test_a_capture_from_elsewhere_says_that_it_has_no_stamps(tmp_path: Path) -> None:
    taken = take(pmp())
    writer = CaptureWriter(tmp_path / "capture", CaptureHeader(taken.sequence, taken.format), len(taken.sequence))
    for position in range(len(taken.sequence)):
        writer.write(taken.frames[position])
    writer.close("complete")
    (tmp_path / "capture" / "frames.jsonl").unlink()
    check = check_capture(Capture.open(tmp_path / "capture")).raise_if_out_of_step()
    assert set(check.summary()) == {"proved", "consistent", "unproved"}
    assert b"no time stamps" in timing_diagram(check)
