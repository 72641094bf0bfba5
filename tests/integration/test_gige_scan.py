"""Scans through the wire: a projector in one world, the GigE camera in another, light told over a socket."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from drivers.aravis import camera_driver
from drivers.registry import open_projector, open_trigger
from drivers.simulated.gige_serve import GigeService
from scanner.clock import MonotonicClock
from scanner.devices import Projector, TriggerMode
from scanner.errors import ConfigError, DeviceNotFound
from scanner.geometry import load_calibration
from scanner.patterns import CameraFormat, McpPattern, PatternSequence
from scanner.sequencer import FinishReason, Rig, acquire
from scanner.sequencer.plan import Mode
from tests.unit.sequencer_bench import QUICK, MemorySink, Taken, pmp, take

pytest.importorskip("gi", reason="cameras behind Aravis need python3-gi (setup/packages.txt)")
pytestmark = pytest.mark.alone

ADDRESS = "127.0.0.41"
EXPOSURE_NS = 12_500_000
SECOND_NS = 1_000_000_000


@contextmanager
def service(folder: Path, device: str = "quick/board?seed=1") -> Iterator[GigeService]:
    light = folder / "light"
    with GigeService(device, address=ADDRESS, count=1, light=light, wire={}, options={}) as it:
        yield it


def projector(folder: Path, device: str = "quick/board?seed=1") -> Projector:
    return open_projector("simulated", device, {"camera_socket": str(folder / "light")}, MonotonicClock())


def scanned(folder: Path, sequence: PatternSequence, *, repeat: int = 1, board: bool = False) -> Taken:
    """A run of a sequence through Aravis. board: a simulated trigger board is wired to the camera's line."""
    clock, device = MonotonicClock(), "quick/board?seed=1"
    options = {"packet_size": 9000, "line_latency_us": [5.0, 12.0]}
    with service(folder, device) as it, ExitStack() as opened:
        shown = open_projector("simulated", device, {"camera_socket": str(folder / "light")}, clock)
        opened.callback(shown.close)
        trigger = open_trigger("simulated", device, {}, clock) if board else None
        if trigger is not None:
            opened.callback(trigger.close)
        camera = camera_driver.open(ADDRESS, options, clock)
        try:
            rig = Rig(shown, camera, trigger)
            sink = MemorySink()
            exposure_ns = 8_000_000 if board else EXPOSURE_NS
            made = rig.plan(sequence, exposure_ns=exposure_ns, repeat=repeat)
            acquisition = acquire(rig, made, sequence, sink, clock)
            caps = camera.capabilities
            truth = it.cameras[0].world.view.truth
            return Taken(acquisition, sequence, sink, truth, CameraFormat(caps.width, caps.height, caps.bits))
        finally:
            camera.close()


def test_pmp_through_the_wire_is_as_good_as_the_direct_path(tmp_path: Path) -> None:
    sequence = pmp(shifts=(4, 4))
    wire, direct = scanned(tmp_path, sequence), take(sequence, exposure_ns=EXPOSURE_NS)
    assert wire.acquisition.reason is FinishReason.COMPLETED
    assert wire.acquisition.report()["verdicts"]["proved"] == len(sequence)
    ours, theirs = (float(np.sqrt(np.mean(np.square(each.error_px())))) for each in (wire, direct))
    assert ours <= 1.1 * theirs


def test_a_trigger_board_fires_the_camera_on_the_wire(tmp_path: Path) -> None:
    sequence = pmp(shifts=(4, 4))
    wire = scanned(tmp_path, sequence, board=True)
    assert wire.acquisition.plan.mode is Mode.HARDWARE
    assert wire.acquisition.reason is FinishReason.COMPLETED
    assert wire.acquisition.report()["verdicts"]["proved"] == len(sequence)
    assert wire.acquisition.retakes == 0


def test_mcp_through_the_wire(tmp_path: Path) -> None:
    sequence = PatternSequence(QUICK, McpPattern(bits=2, carriers=(20.0, 30.0), codes=(0, 1, 2, 3)))
    wire = scanned(tmp_path, sequence, repeat=2)
    assert wire.acquisition.reason is FinishReason.COMPLETED
    direct = take(sequence, exposure_ns=EXPOSURE_NS, mode=TriggerMode.FREE)
    for frame in wire.sink.frames:
        assert np.abs(frame.astype(float) - direct.sink.frames[0]).mean() < 2.0


def test_the_light_goes_on_when_the_camera_comes_back(tmp_path: Path) -> None:
    with service(tmp_path):
        shown = projector(tmp_path)
        try:
            c = shown.capabilities
            white, ramp = np.full((c.height, c.width), 255, np.uint8), np.tile(np.arange(c.width) % 200, (c.height, 1))
            shown.load([white, ramp.astype(np.uint8), np.eye(c.height, c.width, dtype=np.uint8)])
            shown.show(0)
        except BaseException:
            shown.close()
            raise
    try:
        shown.show(1)  # nobody looks
        with service(tmp_path) as again:
            world = again.cameras[0].world
            for index in (2, 1, 0):
                flip = shown.show(index)
                deadline = time.monotonic() + 2.0
                while world.timeline.between(flip.t_ns + SECOND_NS, flip.t_ns + SECOND_NS)[-1].on_ns < flip.t_ns:
                    assert time.monotonic() < deadline
                    time.sleep(0.002)
            segments = world.timeline.between(flip.t_ns, flip.t_ns + SECOND_NS)
            assert 4_000_000 <= segments[-1].on_ns - flip.t_ns <= 4_400_000
            assert segments[-1].image is not None
            assert (segments[-1].image.content()[1] == 255).all()
            shown.close()
    finally:
        shown.close()


def test_a_projector_without_a_camera_or_in_another_rig(tmp_path: Path) -> None:
    with pytest.raises(DeviceNotFound, match="no simulated camera listens"):
        projector(tmp_path)
    with service(tmp_path), pytest.raises(ConfigError, match="rig quick"):
        projector(tmp_path, "casey2011/board")


LOOK = """
import sys
from drivers.aravis import camera_driver
from scanner.clock import MonotonicClock
from scanner.devices import TriggerMode
found = {info.details["address"]: info.device for info in camera_driver.discover()}
assert found["127.0.0.42"] == "fringed-simulated-gige-7F00002A", found
assert "127.0.0.43" in found
camera = camera_driver.open("7F00002B", {}, MonotonicClock())
camera.start(TriggerMode.FREE)
frames = [camera.pop(10**9) for _ in range(10)]
assert all(frame is not None and frame.complete for frame in frames), frames
print(camera.details["address"])
camera.close()
"""


def test_cameras_of_another_process_are_found_by_an_ordinary_user(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "import sys; from service.cli import main; sys.exit(main())", "simulate", "gige"]
    words = ["quick/board", "--address", "127.0.0.42", "--count", "2", "--light", str(tmp_path / "l"), "--json"]
    calibration = tmp_path / "rig.json"
    with subprocess.Popen([*command, *words, "--calibration", str(calibration)], stdout=subprocess.PIPE) as it:
        try:
            assert it.stdout is not None
            told = json.loads(b"".join(iter(it.stdout.readline, b"}\n")) + b"}")
            assert told["cameras"] == "127.0.0.42, 127.0.0.43"
            assert load_calibration(calibration).camera.size == (320, 240)
            user = 65_534 if os.geteuid() == 0 else None
            seen = subprocess.run(
                [sys.executable, "-c", LOOK],
                capture_output=True,
                text=True,
                check=False,
                timeout=60,
                user=user,
                cwd="/",
            )
            assert seen.returncode == 0, seen.stderr
            assert seen.stdout.strip() == "127.0.0.43"
            if tool := shutil.which("arv-tool-0.8"):  # package aravis-tools-cli, for those who have it
                told_it = subprocess.run(
                    [tool, "-a", "127.0.0.42", "control", "Gain=3", "Width"],
                    capture_output=True,
                    text=True,
                    check=True,
                    timeout=30,
                )
                assert told_it.stdout.splitlines() == ["Gain = 3 dB min:0 max:24", "Width = 320 min:16 max:320 inc:4"]
        finally:
            it.send_signal(signal.SIGINT)
            assert it.wait(10) == 0  # its normal end
    assert not (tmp_path / "l").exists()
