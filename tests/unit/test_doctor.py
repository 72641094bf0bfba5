"""The doctor: a machine made of files, a simulated rig with its faults, and what is told of each."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.registry import open_camera, open_projector
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.projector import SimulatedProjector
from scanner.clock import VirtualClock
from scanner.devices import CameraFrame, Source
from scanner.devices.receive_buffers import enlarging
from scanner.sequencer.light import measure_light
from service import doctor, doctor_rig
from service.config import RigConfig, simulated_rig
from service.doctor import Finding, Level, Machine
from service.doctor_rig import examine_rig
from service.scan_setup import open_rig


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    for name in ("dev/dri", "proc", "sys"):
        (tmp_path / name).mkdir(parents=True)
    return Machine(tmp_path / "dev", tmp_path / "proc", tmp_path / "sys")


def written(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def one(findings: object, subject: str) -> Finding:
    assert isinstance(findings, list)
    (found,) = [finding for finding in findings if finding.subject == subject]
    assert isinstance(found, Finding)
    return found


# --- the machine ----------------------------------------------------------------------------------------------------


def test_a_node_that_may_not_be_opened_names_its_group(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    node = written(machine.dev / "video0", "")
    assert one(list(doctor.device_nodes(machine)), str(node)).level is Level.OK
    monkeypatch.setattr(os, "access", lambda *_: False)
    found = one(list(doctor.device_nodes(machine)), str(node))
    assert found.level is Level.BAD
    assert found.mend.startswith("sudo usermod -aG ")


def test_a_machine_without_devices_is_told_so(machine: Machine) -> None:
    assert one(list(doctor.device_nodes(machine)), "device nodes").level is Level.NOTE


def test_who_holds_a_display_is_named(machine: Machine) -> None:
    card = written(machine.dev / "dri/card0", "")
    assert next(doctor.display_holders(machine)).level is Level.OK
    written(machine.proc / "77/comm", "Xorg\n")
    (machine.proc / "77/fd").mkdir()
    (machine.proc / "77/fd/9").symlink_to(card)
    found = next(doctor.display_holders(machine))
    assert found.level is Level.NOTE
    assert "Xorg (77)" in found.says
    assert "isolate" in found.mend


@pytest.mark.parametrize(("value", "level"), [("0", Level.BAD), ("1", Level.OK)])
def test_stamps_of_uvc_cameras(machine: Machine, value: str, level: Level) -> None:
    written(machine.sys / "module/uvcvideo/parameters/hwtimestamps", value + "\n")
    assert one(list(doctor.modules(machine)), "uvcvideo stamps").level is level


def test_small_usb_memory_and_slow_clocks_are_notes(machine: Machine) -> None:
    written(machine.sys / "module/usbcore/parameters/usbfs_memory_mb", "16")
    written(machine.sys / "devices/system/clocksource/clocksource0/current_clocksource", "hpet")
    assert one(list(doctor.modules(machine)), "USB transfers").level is Level.NOTE
    assert doctor.clock_source(machine).level is Level.NOTE


@pytest.mark.parametrize(("bytes_", "level"), [("212992", Level.NOTE), ("67108864", Level.OK)])
def test_receive_buffers(machine: Machine, bytes_: str, level: Level) -> None:
    written(machine.proc / "sys/net/core/rmem_max", bytes_)
    found = doctor.receive_buffers(machine)
    assert found.level is level
    assert found.mend == ("" if level is Level.OK else enlarging(0))


def test_room_is_that_of_the_nearest_folder_there_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert str(tmp_path) in doctor.room(tmp_path / "not" / "yet").says
    monkeypatch.setattr(doctor, "ROOM_BYTES", 1 << 62)
    assert doctor.room(tmp_path).level is Level.BAD


def test_everything_wrong_says_how_to_mend_it(machine: Machine, tmp_path: Path) -> None:
    written(machine.sys / "module/uvcvideo/parameters/hwtimestamps", "0")
    findings = list(doctor.examine(machine, tmp_path))
    assert len(findings) >= 5
    assert all(finding.mend for finding in findings if finding.level is Level.BAD)


# --- a rig --------------------------------------------------------------------------------------------------------


def examined(device: str, **parts: object) -> list[Finding]:
    rig = simulated_rig(device)
    if parts:
        rig = RigConfig.model_validate({**rig.model_dump(mode="json"), **parts})
    return list(examine_rig(rig, VirtualClock(), lambda _: None))


def test_a_sound_rig_has_nothing_to_mend() -> None:
    findings = examined("quick/board", trigger={"driver": "simulated", "device": "quick/board"})
    assert {finding.level for finding in findings} <= {Level.OK, Level.NOTE}
    assert "60.000 Hz" in one(findings, "trigger line").says
    assert one(findings, "gamma").says == "greys follow an exponent of 2.30, which the calibration undoes"


def test_a_response_that_is_not_the_calibrations_is_told() -> None:
    found = one(examined("quick/board?gamma=1.8"), "gamma")
    assert found.level is Level.NOTE
    assert "1.80" in found.mend


def test_what_a_cameras_driver_finds_on_its_host_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = [SimpleNamespace(subject="packet size", ok=False, text="1500 bytes", command="ip link set ...")]
    monkeypatch.setattr(SimulatedCamera, "check_setup", lambda self, rate_hz=None: seen, raising=False)
    found = one(examined("quick/board"), "packet size")
    assert (found.level, found.mend) == (Level.BAD, "ip link set ...")


def test_a_latency_nobody_wrote_down_is_given_in_the_rig_files_words() -> None:
    found = one(examined("quick/board?declare_latency=false"), "latency")
    assert found.level is Level.NOTE
    assert "latency_us = [" in found.mend


def test_a_latency_that_is_not_what_the_rig_file_says_is_bad() -> None:
    projector = {"driver": "simulated", "device": "quick/board", "latency_us": [40_000, 41_000], "settle_us": 500}
    found = one(examined("quick/board", projector=projector), "latency")
    assert found.level is Level.BAD
    assert "rig file" in found.says


def test_a_latency_without_a_settling_is_judged_as_check_config_judges_it() -> None:
    device = {"driver": "simulated", "device": "quick/board?declare_latency=false"}
    found = one(examined(device["device"], projector={**device, "latency_us": [4_000, 4_400]}), "latency")
    assert found.level is Level.NOTE
    assert "latency_us without settle_us" in found.says
    assert "settle_us = [" in found.mend


def test_greys_made_of_pulses_are_seen() -> None:
    assert "constant" in one(examined("quick/board"), "grey").says
    assert "pulses" in one(examined("quick/board?modulation=pwm"), "grey").says


def test_a_dark_view_ends_in_words_and_the_rest_goes_on() -> None:
    findings = examined("quick/board?exposure_scale=0.01")
    found = one(findings, "light")
    assert found.level is Level.BAD
    assert "open the lens" in found.mend


def test_devices_that_cannot_be_opened_are_one_finding() -> None:
    camera = {"driver": "simulated", "device": "quick/nowhere"}
    findings = examined("quick/board", camera=camera)
    assert [finding.subject for finding in findings] == ["devices"]
    assert findings[0].level is Level.BAD


def test_a_board_that_hears_nothing_is_bad() -> None:
    device = "quick/board?source_ends_after=0"
    found = one(examined(device, trigger={"driver": "simulated", "device": device}), "trigger line")
    assert found.level is Level.BAD
    assert "VSYNC" in found.says


# --- the picture --------------------------------------------------------------------------------------------------


def pictured(monkeypatch: pytest.MonkeyPatch, change: Callable[[np.ndarray], np.ndarray]) -> list[Finding]:
    """What is found of a projector that makes something else of its images; gamma 2.3."""
    load = SimulatedProjector.load
    monkeypatch.setattr(SimulatedProjector, "load", lambda self, images: load(self, [change(i) for i in images]))
    opened = open_rig(simulated_rig("quick/board").model_dump(mode="json"), clock := VirtualClock())
    try:
        return list(doctor_rig.picture(opened, clock))
    finally:
        opened.close()


def _keystoned(image: np.ndarray) -> np.ndarray:
    """Nine tenths of its width, by linear interpolation, in a black frame."""
    height, width = image.shape
    small = cv2.resize(image, (round(0.9 * width), height), interpolation=cv2.INTER_LINEAR)
    return np.pad(small, ((0, 0), (0, width - small.shape[1])))


def test_a_picture_that_comes_as_it_is_sent_is_sound(monkeypatch: pytest.MonkeyPatch) -> None:
    findings = pictured(monkeypatch, lambda image: image)
    assert [(found.subject, found.level) for found in findings] == [
        ("pixels", Level.OK),
        ("dynamics", Level.OK),
        ("room light", Level.OK),
        ("refresh", Level.OK),
    ]
    assert "60.000 Hz" in findings[3].says


def test_keystone_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    found = one(pictured(monkeypatch, _keystoned), "pixels")
    assert found.level is Level.BAD
    assert "keystone" in found.mend


def test_dynamic_contrast_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    def dimmed(image: np.ndarray) -> np.ndarray:
        return image if image.mean() > 100 else (0.8 * image).astype(np.uint8)

    found = one(pictured(monkeypatch, dimmed), "dynamics")
    assert found.level is Level.BAD
    assert "dynamic contrast" in found.mend


def test_light_that_swings_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    pop, swing = SimulatedCamera.pop, itertools.cycle((0, 3, 1, 4))

    def lit(self: SimulatedCamera, timeout_ns: int) -> CameraFrame | None:
        frame = pop(self, timeout_ns)
        return frame and replace(frame, pixels=frame.pixels + np.uint8(next(swing)))

    monkeypatch.setattr(SimulatedCamera, "pop", lit)
    found = one(pictured(monkeypatch, lambda image: image), "room light")
    assert found.level is Level.BAD
    assert "50 Hz" in found.mend


def test_stamps_that_prove_nothing_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    assert one(examined("quick/board"), "stamps").level is Level.OK
    honest = SimulatedCamera.capabilities
    estimated = property(lambda self: replace(honest.fget(self), stamp=Source.ESTIMATED))
    monkeypatch.setattr(SimulatedCamera, "capabilities", estimated)
    assert one(examined("quick/board"), "stamps").level is Level.NOTE


def test_a_rate_that_is_another_is_told() -> None:
    assert doctor_rig._rate(1e9 / 59.94, 16_666_667).level is Level.BAD
    assert doctor_rig._rate(None, 16_666_667).level is Level.OK


# --- light --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.6])
def test_gamma_is_measured(gamma: float) -> None:
    clock, device = VirtualClock(), f"quick/board?gamma={gamma}"
    projector, camera = open_projector("simulated", device, {}, clock), open_camera("simulated", device, {}, clock)
    try:
        found = measure_light(projector, camera, clock)
    finally:
        camera.close()
        projector.close()
    assert found.gamma == pytest.approx(gamma, abs=0.02)
    assert found.gamma_misfit < 0.01
    assert found.flicker < 0.002
    assert found.lit_share > 0.95


def test_stamps_say_their_bound_however_small() -> None:
    clock = VirtualClock()
    with_stamps = open_camera("simulated", "quick/board", {}, clock)
    for bound_ns, said in ((1_500, "1.5 us"), (250_000, "250 us")):
        capabilities = replace(with_stamps.capabilities, stamp_bound_ns=bound_ns)
        opened: Any = SimpleNamespace(rig=SimpleNamespace(camera=SimpleNamespace(capabilities=capabilities)))
        assert f"true within {said}" in one(list(doctor_rig.host(opened, clock)), "stamps").says
    with_stamps.close()
