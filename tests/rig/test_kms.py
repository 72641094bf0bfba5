"""KMS on the kernel's vkms: the contract, exactness read back, long runs, and who holds the card."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.kms import drm, projector_driver
from drivers.kms.card import find, open_card
from drivers.kms.projector import KmsProjector
from drivers.kms.writeback import read_back
from drivers.registry import open_projector
from scanner.clock import MonotonicClock
from scanner.devices import Source
from scanner.errors import ConfigError, DeviceBusy, DeviceError, DeviceLost, DeviceNotFound
from tests.contract.suite import ProjectorBench, ProjectorContract
from tests.rig.punctual import punctual
from tests.rig.six_hundred import decoding_and_writing, flip_six_hundred

OUTPUT = "Virtual-1"
SMALL = "640x480"


def _open(**options: object) -> KmsProjector:
    projector = open_projector("kms", OUTPUT, {"mode": SMALL, **options}, MonotonicClock())
    assert isinstance(projector, KmsProjector)
    return projector


@pytest.fixture
def projector() -> Iterator[KmsProjector]:
    opened = _open()
    yield opened
    opened.close()


@pytest.fixture
def connection() -> Iterator[Callable[[str], None]]:
    """Pulls the cable ("off") and puts it back ("on"): the kernel's own switch for it."""
    card = find(OUTPUT)[0]
    status = Path(f"/sys/class/drm/{card.path.rpartition('/')[2]}-{OUTPUT}/status")
    card.close()
    yield lambda state: (status.write_text(state), None)[1]
    status.write_text("detect")


@pytest.mark.real_time
class TestKmsProjector(ProjectorContract):
    @pytest.fixture
    def bench(self) -> Iterator[ProjectorBench]:
        projector = _open()
        yield ProjectorBench(projector, MonotonicClock())
        projector.close()


def test_what_is_there_is_listed_with_its_modes() -> None:
    found = projector_driver.discover()
    assert any(info.device.endswith(f"/{OUTPUT}") for info in found)
    node, output = find(OUTPUT)
    node.close()
    assert output.native is not None
    assert (output.native.width, output.native.height) == (1024, 768)
    assert {"1024x768", "640x480"} <= {f"{mode.width}x{mode.height}" for mode in output.modes}


def test_without_a_mode_the_native_one_is_set() -> None:
    projector = open_projector("kms", "", {}, MonotonicClock())
    try:
        assert (projector.capabilities.width, projector.capabilities.height) == (1024, 768)
    finally:
        projector.close()


def test_flips_are_of_the_kernel_and_true(projector: KmsProjector) -> None:
    projector.load([np.zeros((480, 640), dtype=np.uint8)])
    flip = projector.show(0)
    assert projector.counts_blanks
    assert flip.source is Source.HARDWARE
    assert flip.bound_ns < 50_000
    asked = drm.CrtcSequence(crtc_id=projector.crtc)
    projector.card.call(drm.CRTC_GET_SEQUENCE, asked)
    blanks = (asked.sequence - flip.vblank) & 0xFFFFFFFF
    assert abs(asked.sequence_ns - flip.t_ns - blanks * projector.capabilities.refresh_ns) <= flip.bound_ns


def test_six_hundred_flips_and_none_skipped_unsaid(projector: KmsProjector) -> None:
    """This machine may be late and make the guest late: the kernel's count tells of every blank that went by unused.

    None goes by where it cannot: test_steady_flips.py.
    """
    with decoding_and_writing():
        flip_six_hundred(projector)


def test_greys_go_out_bit_for_bit(projector: KmsProjector) -> None:
    ramp = np.add.outer(np.arange(480), np.arange(640)).astype(np.uint8)
    noise = np.random.default_rng(1).integers(0, 256, (480, 640), dtype=np.uint8)
    projector.load([ramp, noise])
    for index, image in enumerate((ramp, noise)):
        projector.show(index)
        sent = read_back(projector)
        assert all(np.array_equal(sent[..., colour], image) for colour in range(3))
        projector.show(index)


def test_load_leaves_what_is_on_show(projector: KmsProjector) -> None:
    shape = (480, 640)
    projector.load([np.full(shape, 90, dtype=np.uint8)])
    projector.show(0)
    projector.load([np.full(shape, 180, dtype=np.uint8)])
    assert np.all(read_back(projector) == 90)
    projector.show(0)
    assert np.all(read_back(projector) == 180)


def test_what_changes_greys_is_off(projector: KmsProjector) -> None:
    assert set(projector.exactness) >= {"GAMMA_LUT", "Broadcast RGB"}


def test_somebody_else_is_master() -> None:
    other = _holder()
    try:
        with pytest.raises(DeviceBusy) as caught:
            _open()
        assert f"({other})" in (caught.value.hint or "")
    finally:
        os.kill(other, signal.SIGKILL)
        os.waitpid(other, 0)
    before = time.monotonic()
    again = _open()  # it was killed without a chance to tidy up: the kernel has given the card back
    assert time.monotonic() - before < 5
    again.close()


def _holder() -> int:
    """A process that shows an image and then does nothing; its number."""
    reader, writer = os.pipe()
    if (child := os.fork()) == 0:
        try:
            projector = _open()
            projector.load([np.full((480, 640), 200, dtype=np.uint8)])
            projector.show(0)
            os.write(writer, b"shown")
            time.sleep(60)
        finally:
            os._exit(1)
    os.close(writer)
    assert os.read(reader, 5) == b"shown"
    os.close(reader)
    return child


def test_the_screen_is_given_back(projector: KmsProjector) -> None:
    projector.load([np.full((480, 640), 200, dtype=np.uint8)])
    projector.show(0)
    path, crtc = projector.card.path, projector.crtc
    projector.close()
    card = open_card(path)
    try:
        now = drm.Crtc(crtc_id=crtc)
        card.call(drm.GETCRTC, now)
        assert now.fb_id == 0 or now.mode.hdisplay != 640  # off, or the console's again
    finally:
        card.close()


@pytest.mark.parametrize("state", ["idle", "mid-sequence"])
def test_a_display_that_goes_is_lost_at_once_and_works_when_it_is_back(
    connection: Callable[[str], None], state: str
) -> None:
    black = np.zeros((480, 640), dtype=np.uint8)

    def pull() -> float:
        projector = _open()
        projector.load([black])
        for _ in range(5 if state == "mid-sequence" else 0):
            projector.show(0)
        connection("off")
        before = time.monotonic()
        for use in (projector.check_present, lambda: projector.show(0), lambda: projector.show(0)):
            with pytest.raises(DeviceLost):
                use()
        took = time.monotonic() - before
        projector.close()
        with pytest.raises(DeviceNotFound):
            _open()
        connection("on")
        again = _open()
        again.load([black])
        again.show(0)
        again.close()
        return took

    punctual(1, pull)


def test_what_is_not_there_is_named() -> None:
    with pytest.raises(DeviceNotFound) as caught:
        open_projector("kms", "HDMI-A-7", {}, MonotonicClock())
    assert OUTPUT in (caught.value.hint or "")
    with pytest.raises(DeviceNotFound):
        open_projector("kms", "/dev/dri/card9", {}, MonotonicClock())
    with pytest.raises(DeviceError, match="drives no screens"):
        open_projector("kms", "/dev/null", {}, MonotonicClock())
    with pytest.raises(ConfigError) as mode:
        _open(mode="641x480")
    assert "640x480" in (mode.value.hint or "")
    with pytest.raises(ConfigError):
        _open(brightness=3)
