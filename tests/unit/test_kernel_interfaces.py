"""Request numbers of the kernel's interfaces: they hold direction, number and the size of the structure.

Printed once by a C program that included `linux/videodev2.h` and `drm/drm.h` of Linux 6.1, for x86-64.
"""

from __future__ import annotations

import ctypes
import errno

import pytest

from drivers.ioctl import device_error
from drivers.kms import drm
from drivers.v4l2 import videodev2 as v4l2
from scanner.errors import DeviceBusy, DeviceError, DeviceLost, PermissionDenied

VIDEODEV2 = """
QUERYCAP 0x80685600 ENUM_FMT 0xc0405602 G_FMT 0xc0d05604 S_FMT 0xc0d05605 REQBUFS 0xc0145608 QUERYBUF 0xc0585609
QBUF 0xc058560f DQBUF 0xc0585611 STREAMON 0x40045612 STREAMOFF 0x40045613 G_PARM 0xc0cc5615 S_PARM 0xc0cc5616
QUERYMENU 0xc02c5625 G_EXT_CTRLS 0xc0205647 S_EXT_CTRLS 0xc0205648 ENUM_FRAMESIZES 0xc02c564a
S_DV_TIMINGS 0xc0845657 G_DV_TIMINGS 0xc0845658 ENUM_DV_TIMINGS 0xc0945662 QUERY_DV_TIMINGS 0x80845663
QUERY_EXT_CTRL 0xc0e85667
"""

DRM = """
VERSION 0xc0406400 GET_CAP 0xc010640c SET_CLIENT_CAP 0x4010640d AUTH_MAGIC 0x40046411 SET_MASTER 0x641e
DROP_MASTER 0x641f CRTC_GET_SEQUENCE 0xc018643b GETRESOURCES 0xc04064a0 GETCRTC 0xc06864a1 SETCRTC 0xc06864a2
GETGAMMA 0xc02064a4 SETGAMMA 0xc02064a5 GETENCODER 0xc01464a6 GETCONNECTOR 0xc05064a7 GETPROPERTY 0xc04064aa
RMFB 0xc00464af PAGE_FLIP 0xc01864b0 CREATE_DUMB 0xc02064b2 MAP_DUMB 0xc01064b3 DESTROY_DUMB 0xc00464b4
GETPLANERESOURCES 0xc01064b5 GETPLANE 0xc02064b6 SETPLANE 0xc03064b7 ADDFB2 0xc06864b8 OBJ_GETPROPERTIES 0xc02064b9
OBJ_SETPROPERTY 0xc01864ba ATOMIC 0xc03864bc
"""


def _numbers(listed: str) -> list[tuple[str, int]]:
    words = listed.split()
    return [(name, int(number, 16)) for name, number in zip(words[::2], words[1::2], strict=True)]


@pytest.mark.parametrize(("name", "number"), _numbers(VIDEODEV2))
def test_video_requests_are_the_headers(name: str, number: int) -> None:
    assert getattr(v4l2, name) == number


@pytest.mark.parametrize(("name", "number"), _numbers(DRM))
def test_mode_setting_requests_are_the_headers(name: str, number: int) -> None:
    assert getattr(drm, name) == number


def test_structures_that_no_number_tells_of() -> None:
    """offsetof and sizeof, from the same headers."""
    fields = (v4l2.Buffer.tv_sec, v4l2.Buffer.sequence, v4l2.Buffer.m, v4l2.Buffer.length)
    assert [field.offset for field in fields] == [24, 56, 64, 72]
    kinds = (v4l2.Plane, v4l2.PixFormatMplane, v4l2.ExtControl, v4l2.BtTimings)
    assert [ctypes.sizeof(kind) for kind in kinds] == [64, 192, 20, 124]
    assert [ctypes.sizeof(kind) for kind in (drm.VblankEvent, drm.ModeInfo, drm.PropertyEnum)] == [32, 68, 40]
    assert drm.VblankEvent.sequence.offset == 24


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (errno.ENODEV, DeviceLost),
        (errno.EBUSY, DeviceBusy),
        (errno.EACCES, PermissionDenied),
        (errno.EINVAL, DeviceError),
    ],
)
def test_what_the_kernel_says_becomes_a_named_error(number: int, kind: type[DeviceError]) -> None:
    made = device_error(OSError(number, "said"), "the format cannot be set", "camera")
    assert type(made) is kind
    assert made.device == "camera"
    assert made.hint


def test_pixel_formats_are_four_characters() -> None:
    assert v4l2.fourcc("Y10") == int.from_bytes(b"Y10 ", "little")
    assert v4l2.fourcc_text(v4l2.fourcc("Y10")) == "Y10"
    assert v4l2.fourcc_text(v4l2.fourcc("Y16") | 1 << 31) == "Y16-BE"
