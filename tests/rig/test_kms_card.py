"""The card itself taken away, not only its display's cable: named at once, let go whole, used again when it is back."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.kms.projector import KmsProjector
from drivers.registry import open_projector
from scanner.clock import MonotonicClock
from scanner.devices import Source
from scanner.errors import DeviceLost, DeviceNotFound
from tests.rig import virtio_card
from tests.rig.punctual import punctual

BLACK = np.zeros((480, 640), dtype=np.uint8)


def _open() -> KmsProjector:
    projector = open_projector("kms", virtio_card.DEVICE, {"mode": "640x480"}, MonotonicClock())
    assert isinstance(projector, KmsProjector)
    return projector


def _held() -> tuple[list[str], int]:
    """What this process has open or mapped of cards, and its threads."""
    links = [str(link.readlink()) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    mapped = Path("/proc/self/maps").read_text().splitlines()
    return [line for line in (*links, *mapped) if "/dev/dri" in line], threading.active_count()


@pytest.fixture
def card() -> Iterator[None]:
    virtio_card.plug_in()
    yield
    virtio_card.plug_in()


@pytest.mark.usefixtures("card")
def test_a_card_without_blanks_shows_and_calls_its_stamps_estimates() -> None:
    projector = _open()
    try:
        projector.load([BLACK, BLACK])
        flips = [projector.show(i % 2) for i in range(6)]
    finally:
        projector.close()
    assert not projector.counts_blanks
    assert {flip.source for flip in flips} == {Source.ESTIMATED}
    assert flips[0].bound_ns == projector.capabilities.refresh_ns


def _check_lost(projector: KmsProjector, *, has_images: bool) -> None:
    for use in (projector.check_present, lambda: projector.load([BLACK])):
        with pytest.raises(DeviceLost, match="went away") as lost:
            use()
        assert virtio_card.DEVICE in str(lost.value)
    if has_images:
        with pytest.raises(DeviceLost):
            projector.show(0)


@pytest.mark.real_time
@pytest.mark.usefixtures("card")
@pytest.mark.parametrize("state", ["idle", "loaded", "mid-sequence"])
def test_a_card_taken_away_is_lost_at_once_and_works_when_it_is_back(state: str) -> None:
    took_back: list[float] = []

    def pull() -> float:
        virtio_card.plug_in()
        before = _held()
        projector = _open()
        if state != "idle":
            projector.load([BLACK, BLACK])
        for index in range(5 if state == "mid-sequence" else 0):
            projector.show(index % 2)
        virtio_card.unplug()
        began = time.monotonic()
        _check_lost(projector, has_images=state != "idle")
        took = time.monotonic() - began
        projector.close()
        del projector
        assert _held() == before
        with pytest.raises(DeviceNotFound):
            _open()
        virtio_card.plug_in()
        began = time.monotonic()
        again = _open()
        again.load([BLACK])
        again.show(0)
        took_back.append(time.monotonic() - began)
        again.close()
        return took

    punctual(1, pull)
    print(f"{state}: in use again {min(took_back):.2f} s after its return")
    assert min(took_back) <= 5
