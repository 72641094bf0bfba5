"""Devices that go and come back: noticed while idle, opened again by themselves, named errors meanwhile."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from scanner.clock import VirtualClock
from scanner.errors import ConfigError, DeviceLost, DeviceNotFound
from scanner.wire import error_body
from service import held_devices
from service.config import simulated_rig
from service.devices_link import DevicesLink
from service.held_devices import HeldDevices
from service.pipe import Counted, DeviceFault, Opened, Report
from service.scan_setup import OpenRig, open_rig

DEVICE = "quick/board"


class _Plug:
    """A rig whose camera can be pulled out."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.there = True
        self.opened = self.closed = 0
        monkeypatch.setattr(held_devices, "open_rig", self._open)

    def check_present(self) -> None:
        if not self.there:
            raise DeviceLost("the camera went away", device="camera", hint="plug it in again")

    def _open(self, settings: Any, clock: Any) -> Any:
        if not self.there:
            raise DeviceNotFound("no camera here", device="camera")
        self.opened += 1
        size = SimpleNamespace(width=4, height=3, bits=8, kind=SimpleNamespace(value="static"))
        device = SimpleNamespace(name="one", capabilities=size)
        camera = SimpleNamespace(name="one", capabilities=size, check_present=self.check_present)
        return SimpleNamespace(rig=SimpleNamespace(camera=camera, projector=device, trigger=None), close=self._close)

    def _close(self) -> None:
        self.closed += 1


@pytest.fixture
def plug(monkeypatch: pytest.MonkeyPatch) -> Iterator[_Plug]:
    made = _Plug(monkeypatch)
    yield made
    assert made.opened == made.closed


@pytest.fixture
def said() -> list[Report]:
    return []


@pytest.fixture
def held(plug: _Plug, said: list[Report]) -> Iterator[tuple[HeldDevices, VirtualClock]]:
    clock = VirtualClock()
    devices = HeldDevices(clock, said.append)
    devices.open({})
    yield devices, clock
    devices.close()


def _idle(devices: HeldDevices, clock: VirtualClock, seconds: float) -> None:
    until = clock.now_ns() + round(seconds * 1e9)
    while (pause := devices.pause_s()) is not None and clock.now_ns() + round(pause * 1e9) <= until:
        clock.sleep_until(clock.now_ns() + round(pause * 1e9))
        devices.mind()
    clock.sleep_until(until)


def test_an_idle_device_that_goes_is_told_within_a_second_and_back_within_five(
    plug: _Plug, held: tuple[HeldDevices, VirtualClock], said: list[Report]
) -> None:
    devices, clock = held
    _idle(devices, clock, 10)
    assert [type(report) for report in said] == [Opened]
    plug.there = False
    _idle(devices, clock, 1)
    assert isinstance(said[-1], DeviceFault)
    assert "went away" in said[-1].error.message
    assert devices.opened is None
    assert plug.closed == 1
    _idle(devices, clock, 60)
    assert len(said) == 2
    plug.there = True
    _idle(devices, clock, 3)
    assert isinstance(said[-1], Opened)
    assert devices.opened is not None


def test_a_scan_finds_what_is_back_and_names_what_is_not(plug: _Plug, held: tuple[HeldDevices, VirtualClock]) -> None:
    devices, _ = held
    first = devices.ready()
    plug.there = False
    with pytest.raises(DeviceNotFound, match="no camera here"):
        devices.ready()
    plug.there = True
    assert devices.ready() is not first


def test_a_loss_in_a_scan_is_told_and_nothing_is_left_open(
    plug: _Plug, held: tuple[HeldDevices, VirtualClock], said: list[Report]
) -> None:
    devices, clock = held
    devices.lose(DeviceLost("gone in mid run", device="camera"))
    assert plug.closed == 1
    assert isinstance(said[-1], DeviceFault)
    _idle(devices, clock, 1)
    assert devices.opened is not None


def test_devices_that_fail_again_and_again_are_tried_ever_less_often(held: tuple[HeldDevices, VirtualClock]) -> None:
    devices, clock = held
    pauses = []
    for _ in range(6):
        devices.lose(DeviceLost("no good", device="camera"))
        pauses.append(devices.pause_s())
        clock.sleep_until(clock.now_ns() + 2_000_000_000)
        devices.mind()
        assert devices.opened is not None
    assert pauses == [0.25, 0.5, 1, 2, 2, 2]
    _idle(devices, clock, 11)
    devices.lose(DeviceLost("once more", device="camera"))
    assert devices.pause_s() == 0.25


def test_devices_that_cannot_say_are_left_alone(said: list[Report]) -> None:
    devices = HeldDevices(VirtualClock(), said.append)
    devices.open(simulated_rig(DEVICE).model_dump(mode="json"))
    assert devices.pause_s() is None
    devices.mind()
    assert isinstance(devices.opened, OpenRig)
    devices.close()


def test_a_rig_that_fails_to_open_leaves_nothing_open(monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[str] = []

    def refuse(_: object) -> None:
        raise ConfigError("no such gain", device="camera")

    for kind in ("camera", "projector", "trigger"):
        device = SimpleNamespace(close=lambda kind=kind: closed.append(kind), apply=refuse)
        monkeypatch.setattr(f"drivers.registry.open_{kind}", lambda *_, device=device: device)
    settings = simulated_rig(DEVICE).model_dump(mode="json")
    settings["trigger"] = {"driver": "simulated", "device": "", "options": {}}
    with pytest.raises(ConfigError, match="gain"):
        open_rig(settings, VirtualClock())
    assert sorted(closed) == ["camera", "projector", "trigger"]


def test_what_became_of_frames_is_in_the_status_and_outlives_a_loss() -> None:
    link = DevicesLink({}, lambda *_: None)
    opened = {"camera": {"name": "one"}, "projector": {"name": "two"}}
    link._take(Opened(**copy.deepcopy(opened)))
    assert link.description == opened
    link._take(Counted({"missing": 3}))
    link._take(DeviceFault(error_body(DeviceLost("gone"))))
    assert link.description is None
    link._take(Opened(**copy.deepcopy(opened)))
    assert link.description is not None
    assert link.description["camera"]["counts"] == {"missing": 3}
