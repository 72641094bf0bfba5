"""What KMS needs no card for: modes told apart, outputs named, greys as words, and machines without cards."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.display import check_images
from drivers.kms import card, drm, projector_driver
from drivers.kms.card import Mode, Output, mode_info
from drivers.kms.projector import choose_mode
from drivers.registry import open_projector
from scanner.clock import VirtualClock
from scanner.errors import ConfigError, DeviceError, DeviceNotFound


def _mode(width: int, height: int, hz: float, preferred: bool = False) -> Mode:
    info = drm.ModeInfo(hdisplay=width, vdisplay=height, htotal=width, vtotal=height)
    return Mode(width, height, hz, preferred, bytes(info))


def _output(*modes: Mode) -> Output:
    return Output("/dev/dri/card0", "HDMI-A-1", 31, True, modes, (5,))


FULL_HD = (_mode(1920, 1080, 60.0), _mode(1920, 1080, 60_000 / 1001, preferred=True), _mode(1280, 720, 120.0))


def test_the_native_mode_is_the_preferred_one_else_the_largest() -> None:
    assert choose_mode(_output(*FULL_HD), None, "x") is FULL_HD[1]
    plain = _output(_mode(640, 480, 60.0), _mode(800, 600, 60.0), _mode(800, 600, 75.0))
    assert choose_mode(plain, None, "x").hz == 75.0
    with pytest.raises(DeviceError, match="no mode"):
        choose_mode(_output(), None, "x")


def test_sixty_is_not_59_94() -> None:
    output = _output(*FULL_HD)
    assert choose_mode(output, "1920x1080@60", "x") is FULL_HD[0]
    assert choose_mode(output, "1920x1080@59.94", "x") is FULL_HD[1]
    assert choose_mode(output, "1920x1080", "x") is FULL_HD[1]
    for wanted in ("1920x1080@50", "1024x768"):
        with pytest.raises(ConfigError) as caught:
            choose_mode(output, wanted, "x")
        assert "1280x720@120" in (caught.value.hint or "")
    for wrong in ("wide", "1920@60", "1920x1080@fast"):
        with pytest.raises(ConfigError, match="makes no sense"):
            choose_mode(output, wrong, "x")


def test_a_mode_goes_back_to_the_kernel_as_it_came() -> None:
    assert mode_info(FULL_HD[0]).hdisplay == 1920


def test_interlaced_and_impossible_modes_are_left_out() -> None:
    listed = (drm.ModeInfo * 4)(
        drm.ModeInfo(clock=148_500, hdisplay=1920, htotal=2200, vdisplay=1080, vtotal=1125),
        drm.ModeInfo(clock=74_250, hdisplay=1920, htotal=2200, vdisplay=1080, vtotal=1125, flags=1 << 4),
        drm.ModeInfo(clock=25_000, hdisplay=640, htotal=800, vdisplay=240, vtotal=262, flags=1 << 5),
        drm.ModeInfo(),
    )
    assert [str(mode) for mode in card.modes(listed)] == ["1920x1080@60"]


@pytest.mark.parametrize(
    ("device", "parts"),
    [
        ("", ("", "")),
        ("HDMI-A-1", ("", "HDMI-A-1")),
        ("card1", ("{}/card1", "")),
        ("card1/DP-2", ("{}/card1", "DP-2")),
        ("{}/card1", ("{}/card1", "")),
        ("{}/card1/DP-2", ("{}/card1", "DP-2")),
        ("{}/card7", ("{}/card7", "")),
    ],
)
def test_a_device_string_names_a_card_an_output_or_both(
    device: str, parts: tuple[str, str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(card, "CARDS", tmp_path)
    (tmp_path / "card1").touch()
    assert card.split(device.format(tmp_path)) == tuple(part.format(tmp_path) for part in parts)


def test_a_machine_without_cards_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(card, "CARDS", tmp_path / "dri")
    assert projector_driver.discover() == []
    with pytest.raises(DeviceNotFound) as caught:
        open_projector("kms", "", {}, VirtualClock())
    assert "/dev/dri" in (caught.value.hint or "")


def test_images_of_another_size_or_kind_are_refused() -> None:
    good = np.zeros((4, 6), dtype=np.uint8)
    check_images([good], (4, 6), "x")
    for image in (np.zeros((4, 5), dtype=np.uint8), np.zeros((4, 6), dtype=np.uint16)):
        with pytest.raises(DeviceError, match="image 1"):
            check_images([good, image], (4, 6), "x")
